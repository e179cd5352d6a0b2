"""The metric between embodiments: link states, distances, correspondences, similarity, and fast kernels."""

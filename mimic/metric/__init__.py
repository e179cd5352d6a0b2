"""The metric between embodiments: link states, distances, correspondences, similarity, and its fast kernels."""

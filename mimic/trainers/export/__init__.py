"""Trained networks as functions of other tools: ONNX."""

"""Onboard inference with numpy and onnxruntime only."""

"""ONNX models of users."""

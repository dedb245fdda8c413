"""ONNX files: reader and writer."""

SUFFIX = ".onnx"

"""ONNX files: reader and writer."""

"""Networks: policy specifications, flat genomes, forward passes, export to ONNX."""

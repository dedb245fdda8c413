"""Every file that comes in or goes out, reader and writer of a format side by side; nothing here runs foreign code.

Checkpoints: ``checkpoint_reader`` takes any, our own format among them, ``torch_checkpoint`` is the released
one. Networks of other frameworks: ``onnx``, ``nir``, ``netx``. For other simulators: ``sanafe``, ``ranc``.
"""

ONNX = ".onnx"
NIR = ".nir"
NETX = ".net"
"""How names of files from other frameworks end."""

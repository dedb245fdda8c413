"""Every file that comes in or goes out, reader and writer of a format side by side; nothing here runs foreign code.

Checkpoints, which a graph makes networks: ``checkpoint_reader`` lists their layouts, ours is ``own_checkpoint``,
those of torch are ``torch_checkpoint``. Files that hold a whole network: ``onnx``, ``nir``, ``netx``,
``counters``; :mod:`runtime.inputs.network` lists them. For other simulators: ``sanafe``, ``ranc``.
"""

CHECKPOINTS = (".pt", ".pth", ".t7")
"""How names of checkpoints end; their content says of which layout they are."""

ONNX = ".onnx"
NIR = ".nir"
NETX = ".net"
"""How names of files from other frameworks end."""

NETWORKS = (*CHECKPOINTS, ONNX, NIR, NETX)
"""The same of every trained network."""

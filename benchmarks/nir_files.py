"""Write the NIR files of tests/nir with the packages that they are named after, and what these packages run.

One package at a time, in an environment that has it::

    python benchmarks/nir_files.py snntorch tests/nir

Each network gets a file ``NAME.nir`` and ``NAME.npz``: ``events`` (steps, inputs), one recording, and the spikes of
each spiking layer (steps, neurons) that the package makes of them, by the name of its node. Everything is seeded. The
tests read the files that are there; only this script needs the packages.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import nir
import numpy as np
import torch
from torch import nn

STEPS, TAXELS = 60, 6
INPUTS, HIDDEN, CLASSES = 2 * TAXELS, 16, 4


def events(shape: tuple[int, ...], share: float = 0.25) -> torch.Tensor:
    """Seeded events of one recording, (steps, 1, *shape)."""
    generator = torch.Generator().manual_seed(7)
    return (torch.rand((STEPS, 1, *shape), generator=generator) < share).float()


def drawn(net: nn.Module, gain: float) -> nn.Module:
    """The same module with seeded weights."""
    generator = torch.Generator().manual_seed(11)
    with torch.no_grad():
        for module in net.modules():
            if isinstance(module, nn.Linear | nn.Conv2d | nn.Conv1d):
                fan_in = module.weight[0].numel()
                module.weight.copy_(
                    torch.randn(module.weight.shape, generator=generator) * gain / fan_in**0.5
                )
                if module.bias is not None:
                    module.bias.copy_(torch.randn(module.bias.shape, generator=generator) * 0.1)
    return net


def run(
    net: nn.Module, given: torch.Tensor, step: Callable[[torch.Tensor], object], kinds: tuple[type, ...]
) -> dict:
    """Spikes of each module of the kinds, by its name, (steps, neurons) bool."""
    found: dict[str, list[np.ndarray]] = {}

    def hear(name: str) -> Callable:
        def hook(_module: nn.Module, _inputs: object, output: object) -> None:
            spikes = output[0] if isinstance(output, tuple) else output
            found.setdefault(name, []).append(spikes.detach().reshape(-1).numpy() > 0)

        return hook

    hooks = [
        module.register_forward_hook(hear(name))
        for name, module in net.named_modules()
        if type(module) in kinds
    ]
    with torch.no_grad():
        for now in given:
            step(now)
    for hook in hooks:
        hook.remove()
    return {name: np.stack(rows) for name, rows in found.items()}


def store(folder: Path, name: str, graph: nir.NIRGraph, given: torch.Tensor, spikes: dict) -> None:
    """Write a network and its run."""
    nir.write(folder / f"{name}.nir", graph, compression=None)
    flat = given.reshape(len(given), -1).numpy() > 0
    np.savez_compressed(folder / f"{name}.npz", events=flat, **spikes)
    counts = ", ".join(f"{key} {int(value.sum())}" for key, value in spikes.items())
    print(f"{name}: {(folder / f'{name}.nir').stat().st_size} bytes, spikes {counts}")


def snntorch(folder: Path) -> None:
    """Leaky and Synaptic neurons that reset to zero, an image, and a recurrent layer."""
    import snntorch as snn
    from snntorch.export_nir import export_to_nir

    def leaky(beta: float, shape: tuple[int, ...], threshold: float = 1.0) -> nn.Module:
        return snn.Leaky(
            beta=torch.full(shape, beta),
            threshold=torch.full(shape, threshold),
            init_hidden=True,
            reset_mechanism="zero",
        )

    def synaptic(alpha: float, beta: float, size: int) -> nn.Module:
        return snn.Synaptic(
            alpha=torch.full((size,), alpha),
            beta=torch.full((size,), beta),
            threshold=torch.ones(size),
            init_hidden=True,
            reset_mechanism="zero",
        )

    nets = {
        "snntorch_leaky": (
            nn.Sequential(
                nn.Linear(INPUTS, HIDDEN),
                leaky(0.2, (HIDDEN,), 0.5),
                nn.Linear(HIDDEN, CLASSES),
                leaky(0.9, (CLASSES,)),
            ),
            (INPUTS,),
        ),
        "snntorch_synaptic": (
            nn.Sequential(
                nn.Linear(INPUTS, HIDDEN),
                synaptic(0.7, 0.8, HIDDEN),
                nn.Linear(HIDDEN, CLASSES),
                synaptic(0.5, 0.9, CLASSES),
            ),
            (INPUTS,),
        ),
        "snntorch_conv": (
            nn.Sequential(
                nn.Conv2d(2, 4, 3, padding=1),
                leaky(0.5, (4, 5, 5)),
                nn.AvgPool2d(2),
                nn.Flatten(),
                nn.Linear(16, CLASSES, bias=False),
                leaky(0.9, (CLASSES,)),
            ),
            (2, 5, 5),
        ),
    }
    for name, (net, shape) in nets.items():
        given = events(shape)
        graph = export_to_nir(drawn(net, 2.0), given[0], ignore_dims=[0])
        for module in net.modules():
            if isinstance(module, snn.Leaky | snn.Synaptic):
                module.reset_hidden()
        store(folder, name, graph, given, run(net, given, net, (snn.Leaky, snn.Synaptic)))
    # a reset with reset_delay would take the input of the step after each spike with it, which NIR cannot say
    more = {"init_hidden": True, "reset_mechanism": "zero", "reset_delay": False}
    loops = {
        "snntorch_recurrent": snn.RLeaky(beta=0.5, threshold=0.6, linear_features=HIDDEN, **more),
        "snntorch_one_to_one": snn.RLeaky(
            beta=0.8, threshold=0.6, all_to_all=False, V=torch.linspace(-0.5, 0.5, HIDDEN), **more
        ),
    }
    for name, loop in loops.items():
        net = nn.Sequential(
            nn.Linear(INPUTS, HIDDEN), loop, nn.Linear(HIDDEN, CLASSES), leaky(0.9, (CLASSES,))
        )
        given = events((INPUTS,))
        graph = export_to_nir(drawn(net, 2.0), given[0], ignore_dims=[0])
        for module in (net[1], net[3]):
            module.reset_mem()
        store(folder, name, graph, given, run(net, given, net, (snn.Leaky, snn.RLeaky)))


def norse(folder: Path) -> None:
    """Leaky neurons in a box, and neurons without leak."""
    from norse.torch import IAFCell, IAFParameters, LIFBoxCell, LIFBoxParameters, SequentialState
    from norse.torch.utils.export_nir import to_nir

    def box(tau: float, threshold: float, size: int) -> nn.Module:
        full = torch.ones(size)
        return LIFBoxCell(p=LIFBoxParameters(tau_mem_inv=full / tau, v_th=full * threshold, v_leak=full * 0))

    def plain(size: int) -> nn.Module:
        return IAFCell(p=IAFParameters(v_th=torch.ones(size)))

    nets = {
        "norse_lif": SequentialState(
            nn.Linear(INPUTS, HIDDEN),
            box(0.002, 0.3, HIDDEN),
            nn.Linear(HIDDEN, CLASSES),
            box(0.01, 0.05, CLASSES),
        ),
        "norse_iaf": SequentialState(
            nn.Linear(INPUTS, HIDDEN), plain(HIDDEN), nn.Linear(HIDDEN, CLASSES), plain(CLASSES)
        ),
    }
    for name, net in nets.items():
        given = events((INPUTS,))
        graph = to_nir(drawn(net, 2.0), given[0])
        state = [None]

        def step(now: torch.Tensor, net: nn.Module = net, state: list = state) -> None:
            _, state[0] = net(now, state[0])

        store(folder, name, graph, given, run(net, given, step, (LIFBoxCell, IAFCell)))


def sinabs(folder: Path) -> None:
    """Neurons with and without leak, of one spike a step and a reset to zero."""
    import sinabs.layers as sl
    from sinabs.activation import MembraneReset, SingleSpike
    from sinabs.nir import to_nir

    def neuron(kind: type, **more: object) -> nn.Module:
        return kind(batch_size=1, spike_fn=SingleSpike, reset_fn=MembraneReset(), **more)

    nets = {
        "sinabs_lif": (
            nn.Sequential(
                nn.Linear(INPUTS, HIDDEN),
                neuron(
                    sl.LIFSqueeze,
                    tau_mem=torch.full((HIDDEN,), 4.0),
                    spike_threshold=torch.full((HIDDEN,), 0.3),
                ),
                nn.Linear(HIDDEN, CLASSES),
                neuron(
                    sl.LIFSqueeze,
                    tau_mem=torch.full((CLASSES,), 10.0),
                    spike_threshold=torch.full((CLASSES,), 0.1),
                ),
            ),
            (INPUTS,),
        ),
        "sinabs_iaf": (
            nn.Sequential(
                nn.Conv2d(2, 4, 3, padding=1, stride=(2, 1)),
                neuron(sl.IAFSqueeze),
                sl.SumPool2d(2),
                nn.Flatten(),
                nn.Linear(8, CLASSES),
                neuron(sl.IAFSqueeze),
            ),
            (2, 5, 5),
        ),
    }
    for name, (net, shape) in nets.items():
        given = events(shape)
        drawn(net, 2.0)
        with torch.no_grad():
            net(given[0])
        graph = to_nir(net, given[0])
        graph.infer_types()  # it leaves the shapes of images open
        for module in net.modules():
            if isinstance(module, sl.StatefulLayer):
                module.reset_states()
        store(folder, name, graph, given, run(net, given, net, (sl.LIFSqueeze, sl.IAFSqueeze)))


def spikingjelly(folder: Path) -> None:
    """Leaky neurons that reset to a value, neurons without leak, learnt decays, and neurons with a current."""
    from spikingjelly.activation_based import functional, layer, neuron
    from spikingjelly.activation_based.nir_exchange import export_to_nir

    nets = {
        "spikingjelly_lif": (
            nn.Sequential(
                layer.Linear(INPUTS, HIDDEN),
                neuron.LIFNode(tau=2.0, v_threshold=0.4, v_reset=-0.1),
                layer.Linear(HIDDEN, CLASSES),
                neuron.ParametricLIFNode(init_tau=5.0, v_threshold=0.2, decay_input=False),
            ),
            (INPUTS,),
        ),
        "spikingjelly_if": (
            nn.Sequential(
                layer.Conv2d(2, 4, 3, padding=1, bias=False),
                neuron.IFNode(),
                layer.AvgPool2d(2),
                layer.Flatten(),
                layer.Linear(16, CLASSES),
                neuron.IFNode(),
            ),
            (2, 5, 5),
        ),
        "spikingjelly_cuba": (
            nn.Sequential(
                layer.Linear(INPUTS, HIDDEN, bias=False),
                neuron.CUBALIFNode(c_decay=0.5, v_decay=0.8),
                layer.Linear(HIDDEN, CLASSES),
                neuron.CUBALIFNode(c_decay=0.25, v_decay=0.9),
            ),
            (INPUTS,),
        ),
    }
    kinds = (neuron.LIFNode, neuron.IFNode, neuron.ParametricLIFNode, neuron.CUBALIFNode)
    for name, (net, shape) in nets.items():
        given = events(shape)
        functional.reset_net(drawn(net, 2.0))
        graph = export_to_nir(net, given[0], dt=0.02)
        functional.reset_net(net)
        store(folder, name, graph, given, run(net, given, net, kinds))


PACKAGES = {make.__name__: make for make in (snntorch, norse, sinabs, spikingjelly)}


def main() -> None:
    """Write the files of one package."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("package", choices=tuple(PACKAGES))
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(3)
    PACKAGES[arguments.package](arguments.folder)


if __name__ == "__main__":
    main()

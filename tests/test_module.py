"""Torch modules compiled from Python: layer types of their own, and what is refused."""

import numpy as np
import pytest
import torch
from made_files import recorded, sparse_events
from made_modules import CLASSES, NETS, TAXELS, AllSteps, OneStep, example_of, mlp, seeded
from numpy.testing import assert_allclose
from oracles import refused
from torch import nn
from torch.nn.utils import prune, weight_norm

import spikeloom
from spikeloom.compiler.errors import ModelError, OptionError
from spikeloom.compiler.interpret import channels_last, run_float
from spikeloom.compiler.targets.loihi1.passes import compile_network
from spikeloom.models.networks.lif import LIF, reset
from spikeloom.models.networks.module import module_network
from spikeloom.runtime.equivalence.verify import verify

STEPS = 12


def events_of(network, samples=3):
    shape = (samples, network.input.taxels, network.input.polarities, STEPS)
    return sparse_events(5, *shape, rate=0.4)


def as_input(name, events, step):
    """One step of a recording (taxels, polarities, steps) in the shape that a net of this name takes."""
    frame = torch.tensor(events[:, :, step], dtype=torch.float64)
    return (
        frame.T.reshape(example_of(name).shape) if name == "grid" else frame.reshape(example_of(name).shape)
    )


def by_torch(name, events):
    """Spikes of each LIF layer by the module itself in float64, one list of (samples, steps, neurons) a layer."""
    net = NETS[name]().double()
    layers = [module for module in net.modules() if isinstance(module, LIF)]
    spikes = []
    for recording in events:
        reset(net)
        steps = []
        for step in range(STEPS):
            net(as_input(name, recording, step))
            steps.append([layer.spikes.detach().numpy().ravel().astype(bool) for layer in layers])
        spikes.append(steps)
    return [np.array([[step[i] for step in steps] for steps in spikes]) for i in range(len(layers))]


@pytest.mark.parametrize("name", NETS)
def test_spikes_are_the_modules_own(name):
    network = module_network(NETS[name](), example_of(name))
    events = events_of(network)
    expected = by_torch(name, events)
    found = run_float(network, channels_last(events)).spikes
    assert len(found) == len(expected)
    for population, ours, theirs in zip(network.populations, found, expected, strict=True):
        assert np.array_equal(ours, theirs), population.name
    assert any(spikes.any() for spikes in expected)
    assert network.classes == CLASSES


def test_weights_and_constants_are_the_modules_to_the_last_bit():
    net = mlp()
    network = module_network(net, torch.zeros(1, 12))
    assert [(p.name, p.size, p.beta, p.theta) for p in network.populations] == [
        ("1", 16, 0.9, 1.0),
        ("3", 3, 0.3, 0.25),
    ]
    assert (network.input.taxels, network.input.polarities) == (6, 2)
    for linear, population, projection in zip(
        [net[0], net[2]], network.populations, network.projections, strict=True
    ):
        assert np.array_equal(projection.weight.toarray(), linear.weight.detach().double().numpy())
        assert np.array_equal(population.bias, linear.bias.detach().double().numpy())


def test_convolution_stores_no_synapse_that_is_not_there():
    network = module_network(NETS["grid"](), example_of("grid"))
    # 16 places, 9 in the window of an inner one, 6 at an edge, 4 in a corner; 2 polarities to 4 features
    assert network.projections[0].weight.nnz == (4 * 9 + 8 * 6 + 4 * 4) * 2 * 4


class TwoWays(nn.Module):
    """Two layers beside each other, received by a third."""

    def __init__(self, *, skip=False):
        super().__init__()
        self.a, self.b, self.c = nn.Linear(4, 3), nn.Linear(4, 5), nn.Linear(12 if skip else 8, 2)
        self.lif_a, self.lif_b, self.lif_c = LIF(), LIF(0.7), LIF()
        self.skip = skip

    def forward(self, x):
        parts = [self.lif_a(self.a(x)), self.lif_b(self.b(x)), *([x] if self.skip else [])]
        return self.lif_c(self.c(torch.cat(parts, -1)))


def test_layers_beside_each_other():
    net = seeded(TwoWays)
    network = module_network(net, torch.zeros(1, 4))
    assert [(p.pre, p.post) for p in network.projections] == [(-1, 0), (-1, 1), (0, 2), (1, 2)]
    found = verify(compile_network(network).netlist, network, recorded(events_of(network)))
    assert found.spec_equals_engine


def test_an_example_may_have_no_batch_axis():
    class Flat(nn.Module):
        def __init__(self):
            super().__init__()
            self.one, self.two = nn.Linear(2, 3), nn.Linear(3 * TAXELS, CLASSES)
            self.lif_one, self.lif_two = LIF(), LIF()

        def forward(self, x):
            return self.lif_two(self.two(self.lif_one(self.one(x)).view(-1)))

    net = seeded(Flat)
    network = module_network(net, torch.zeros(TAXELS, 2))
    assert np.array_equal(network.projections[1].weight.toarray(), net.two.weight.detach().double().numpy())
    block = network.projections[0].weight.toarray()[:3, :2]
    assert np.array_equal(block, net.one.weight.detach().double().numpy())


def test_groups_of_neurons_vote_for_a_class():
    class Grouped(nn.Module):
        def __init__(self):
            super().__init__()
            self.linear, self.lif = nn.Linear(4, 6), LIF()

        def forward(self, x):
            return self.lif(self.linear(x)).view(-1, 3, 2).sum(-1)

    network = module_network(seeded(Grouped), torch.zeros(1, 4))
    assert network.readout.label.tolist() == [0, 0, 1, 1, 2, 2]
    assert network.classes == 3


def test_training_has_a_gradient_and_evaluation_leaves_no_state():
    net = mlp()
    net(torch.ones(1, 12)).sum().backward()
    assert net[0].weight.grad is not None
    reset(net)
    step = OneStep(net, torch.zeros(1, 12))
    output, *state = step(torch.ones(1, 12), *step.rest)
    assert torch.equal(output, state[3])
    with torch.no_grad():
        mean = AllSteps(net)(torch.ones(1, 12, 4))
        assert mean.shape == (1, CLASSES)
    assert all(module.membrane is None for module in net.modules() if isinstance(module, LIF))


def twice():
    neurons = LIF()
    return nn.Sequential(nn.Linear(4, 4), neurons, nn.Linear(4, 4), neurons)


class Subtracting(LIF):
    """Its membrane keeps what exceeds the threshold."""

    def forward(self, current):
        spikes = super().forward(current)
        self.membrane = self.membrane - spikes * self.theta
        return spikes


class Recurrent(nn.Module):
    """Its current adds the spikes of the step before."""

    def __init__(self):
        super().__init__()
        self.linear, self.back, self.lif = nn.Linear(4, 3), nn.Linear(3, 3), LIF(0.5, 0.3)

    def forward(self, x):
        current = self.linear(x)
        return self.lif(current if self.lif.spikes is None else current + self.back(self.lif.spikes))


class Single(nn.Module):
    """Makes float32 of its own."""

    def __init__(self, make):
        super().__init__()
        self.linear, self.lif, self.make = nn.Linear(4, 3), LIF(), make

    def forward(self, x):
        return self.lif(self.make(self, x))


REFUSED = {
    "but got Float and Double); it is read in float64, so": lambda: Single(lambda m, x: m.linear(x.float())),
    "got: double != float); it is read in float64, so": lambda: Single(
        lambda m, x: m.linear(x) @ torch.eye(3)
    ),
    "of the response, as of float32 made inside it, 1e-09": lambda: Single(lambda m, x: m.linear(x).float()),
    "module 1: has a forward of its own": lambda: nn.Sequential(nn.Linear(4, 2), Subtracting()),
    "module: the stage before lif is not affine": Recurrent,
    "module: the stage before 3 is not affine (a random combination": lambda: nn.Sequential(
        nn.Linear(4, 3), LIF(), nn.Sequential(nn.Linear(3, 2), nn.ReLU()), LIF()
    ),
    "module: has no LIF layer, so nothing spikes": lambda: nn.Linear(4, 2),
    "module 1: is called 2 times in a step": twice,
    "module: its output is no count of the spikes": lambda: nn.Sequential(
        nn.Linear(4, 3), LIF(), nn.Linear(3, 2)
    ),
    "layer lif_c: receives the input and lif_a and lif_b, which are at different depths": lambda: TwoWays(
        skip=True
    ),
    "layer 1: keeps 1.5 of its membrane in a step": lambda: nn.Sequential(nn.Linear(4, 2), LIF(beta=1.5)),
    "layer 1: has the threshold 0, allowed are numbers above 0": lambda: nn.Sequential(
        nn.Linear(4, 2), LIF(theta=0)
    ),
}


def test_what_a_module_says_itself_is_not_given_beside_it():
    refused(
        OptionError,
        "compile: beta is for files, and a module says it itself",
        spikeloom.compile,
        seeded(mlp),
        example=torch.zeros(1, 12),
        beta=0.9,
    )


@pytest.mark.parametrize("words", REFUSED)
def test_refused(words):
    refused(ModelError, words, module_network, seeded(REFUSED[words]), torch.zeros(1, 4))


@pytest.mark.filterwarnings("ignore:.*weight_norm:FutureWarning")
@pytest.mark.parametrize("change", [lambda dense: prune.l1_unstructured(dense, "weight", 0.5), weight_norm])
def test_weights_that_a_hook_computes_are_as_it_computes_them(change):
    dense = nn.Linear(6, 4)
    module = nn.Sequential(dense, LIF(beta=0.5, theta=0.5))
    change(dense)
    (projection,) = spikeloom.compile(module, example=torch.zeros(1, 6)).network.projections
    assert_allclose(projection.weight.toarray(), dense.weight.detach().numpy(), rtol=1e-6)


class Computed(nn.Module):
    """Keeps a tensor that is computed from a parameter."""

    def __init__(self, keep):
        super().__init__()
        self.dense = nn.Linear(6, 4)
        self.neurons = LIF(beta=0.5, theta=0.5)
        keep(self, self.dense.weight * 2)

    def forward(self, x):
        self.twice += 0 * x.sum()
        return self.neurons(nn.functional.linear(x, self.twice))


KEPT = {
    "an attribute": lambda module, value: setattr(module, "twice", value),
    "a buffer": lambda module, value: module.register_buffer("twice", value),
}


@pytest.mark.parametrize("keep", KEPT.values(), ids=KEPT)
def test_tensors_that_a_module_computed_are_copied(keep):
    module = Computed(keep)
    before = module.twice.detach().clone()
    (projection,) = spikeloom.compile(module, example=torch.ones(1, 6)).network.projections
    assert_allclose(projection.weight.toarray(), before.numpy(), rtol=1e-6)
    assert torch.equal(module.twice, before)


def test_a_module_that_cannot_be_copied_is_refused():
    module = nn.Sequential(nn.Linear(6, 4), LIF(beta=0.5, theta=0.5))
    module.kept = [module[0].weight * 2]
    refused(ModelError, "cannot be copied", module_network, module, torch.zeros(1, 6))

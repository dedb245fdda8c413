"""What the compiler refuses: the class of the error, the words that its message must hold, and the call."""

import dataclasses
import itertools

import numpy as np
import pytest
from oracles import refused
from random_networks import LOIHI, chain, integer_chain, random_checkpoint, ring, small_target

from spikeloom.compiler import Options, Packing, compile_network
from spikeloom.compiler.errors import CapacityError, DataError, ModelError, OptionError
from spikeloom.compiler.passes.calibrate import calibrate
from spikeloom.compiler.passes.expand import expand
from spikeloom.compiler.targets.loihi1.layout.choose import lay_out, least_cores
from spikeloom.compiler.targets.loihi1.layout.partition import partition
from spikeloom.compiler.targets.loihi1.storage.choose_storage import choose_storage
from spikeloom.compiler.targets.loihi1.storage.width_search import check_widths

EVENTS = np.ones((2, 5, 2, 8), np.uint8)
WIDTHS = "2, 3, 4, 5, 6, 8"


def compiling(target="loihi1", graph=5, **options):
    return lambda: compile_network(expand(random_checkpoint(), ring(graph)), Options(**options), target=target)


def rounding(weight=1.0, **options):
    return lambda: choose_storage(chain([[weight]]), LOIHI, **options)


def calibrating(shape):
    return lambda: calibrate(chain([[1.0, 1.0]]), np.zeros(shape, bool))


def goal(name, cores_for=None, *, calibrated=True, chips=1):
    options = Options(optimize=name, cores_for=cores_for or {}, chips=chips)
    return lambda: options.require_consistent(calibrated=calibrated)


def full(*sizes):
    return integer_chain(*[np.full((post, pre), 2) for pre, post in itertools.pairwise(sizes)])


def laying_out(sizes, target=LOIHI, **cores_for):
    return lambda: lay_out(full(*sizes), target, cores_for=cores_for)


def cutting(sizes, **limits):
    return lambda: partition(full(*sizes), small_target(**limits))


OPTIONS = [
    ("--prune-unused|--calibrate|--keep-all", compiling(prune_unused=True)),
    ("--prune-unused|--keep-all", compiling(prune_unused=True, training_events=EVENTS, keep_all=True)),
    ("--spike-exact|--calibrate", compiling(spike_exact=True)),
    ("--spike-exact|--planes", compiling(spike_exact=True, training_events=EVENTS, packings=(Packing(planes=2),))),
    (f"--weight-bits 7|{WIDTHS}", compiling(spike_exact=True, training_events=EVENTS, packings=(Packing(bits=7),))),
    *((f"--weight-bits {bits}|{WIDTHS}", rounding(packings=(Packing(bits=bits),))) for bits in (-1, 0, 1, 7, 9)),
    *((f"--planes {planes}|1 to 3", rounding(packings=(Packing(planes=planes),))) for planes in (0, 4)),
    *((f"--scale-groups {n}|8 thresholds|1 to 8", rounding(packings=(Packing(groups=n),))) for n in (0, 9)),
    ("--weight-bits: 2 layers|the network has 1", rounding(packings=(Packing(), Packing()))),
    (f"--widths 7|{WIDTHS}", lambda: check_widths([7], 1, 4, LOIHI)),
    ("--optimize speed|cores, latency", goal("speed")),
    ("--optimize latency|--calibrate", goal("latency", calibrated=False)),
    ("--optimize latency|--cores-for", goal("latency", {"fc1": 2})),
    ("--optimize latency|no time", lambda: lay_out(full(2, 2), dataclasses.replace(LOIHI, time=()), goal="latency")),
    ("--optimize latency|links between chips|--chips", goal("latency", chips=2)),
    ("--chips 0|1 or more", goal("cores", chips=0)),
    ("--cores-for fc9=2|fc1, fc2", laying_out((3, 200, 4), fc9=2)),
    ("--cores-for fc1=129|128 cores|128 or fewer", laying_out((3, 200, 4), fc1=129)),
    ("--cores-for fc1=2|3 cores at least", laying_out((2496, 128), fc1=2)),
    # four neurons of seven output axons a core: three listening cores each let two of them sit together
    ("--cores-for fc1=1|2 cores at least", laying_out((1, 4, 9), small_target(core_axons_out=7), fc1=1, fc2=3)),
    ("--cores-for fc1=7|3 chips|6 cores", lambda: least_cores(full(6, 8), {"fc1": 7}, small_target(chip_cores=2), 3)),
]
NETWORKS = [
    ("fc1|6 bits|32767 units|more bits", rounding(1e6, packings=(Packing(bits=6),))),
]
RECORDINGS = [
    ("calibration|split is empty", compiling(training_events=EVENTS[:0])),
    ("calibration|split is empty", calibrating((0, 5, 2))),
    ("3 channels|has 2", calibrating((1, 5, 3))),
]
CAPACITIES = [
    (
        "fc1 neuron 0: 8 used, 7 allowed (loihi1.core.axons_out)",
        laying_out((1, 1, 8), small_target(core_axons_out=7), fc2=8),
    ),
    ("chip: 129 used, 128 allowed (loihi1.chip.cores)", laying_out((3, 100, 100), fc1=100, fc2=29)),
    (
        "2 chips: 5 used, 4 allowed (loihi1.chip.cores)|--chips",
        lambda: partition(full(1, 5), small_target(core_compartments=1, chip_cores=2), chips=2),
    ),
    ("fc1 neuron 0: 4097 used, 4096 allowed (loihi1.core.axons_in)", cutting((4097, 1))),
    (
        "neuron 0: 16385 used, 4096 allowed (loihi1.core.axons_in)|\n"
        "fc1 neuron 0: 16385 used, 16384 allowed (loihi1.core.synapse_words)",
        cutting((16385, 1)),
    ),
    (
        "fc1 neuron 0: 5 used, 4 allowed (loihi1.core.axons_out); split the layers that it feeds",
        cutting((1, 1, 5), core_axons_out=4, core_compartments=1),
    ),
    ("fc1 neuron 0: 5 used, 4 allowed (loihi1.core.synapse_words)", cutting((5, 1), core_synapse_words=4)),
    *(
        (f"fc1 neuron 0: 1 used, 0 allowed (loihi1.core.{rule})", cutting((1, 1), **{f"core_{rule}": 0}))
        for rule in ("compartments", "threshold_slots", "compartment_configs")
    ),
]
TABLE = {OptionError: OPTIONS, ModelError: NETWORKS, DataError: RECORDINGS, CapacityError: CAPACITIES}


@pytest.mark.parametrize(("error", "words", "call"), [(error, *row) for error, rows in TABLE.items() for row in rows])
def test_what_cannot_be_had_is_refused(error, words, call):
    refused(error, words, call)


def test_what_is_just_allowed():
    assert least_cores(full(2496, 128), {"fc1": 3}, LOIHI) == {0: 3}
    assert least_cores(full(6, 8), {"fc1": 6}, small_target(chip_cores=2), 3) == {0: 6}
    assert check_widths([8, 2, 8], 1, 4, LOIHI) == (2, 8)
    assert check_widths([2, 3, 4, 5, 6, 8], 1, 4, LOIHI) == (2, 3, 4, 5, 6, 8)
    assert len(partition(full(4096, 1), LOIHI)) == 1
    assert len(partition(full(1, 128 * 8), small_target(core_compartments=8))) == 128
    assert len(cutting((1, 1, 5), core_axons_out=5, core_compartments=1)()) == 6
    assert len(partition(full(1, 4, 9), small_target(core_axons_out=7), cores_for={1: 3})) == 5

"""What the options of ``compile`` ask for: storage of each layer, cores, and what a netlist remembers of it."""

from collections.abc import Mapping, Sequence
from typing import Any

from spikeloom.compiler import __version__
from spikeloom.compiler.errors import OptionError
from spikeloom.compiler.ir import Form
from spikeloom.compiler.storage import Cheapest, Exact, Fixed, Given, Packing, Storage
from spikeloom.compiler.targets.netlist_file import origin_of
from spikeloom.compiler.types import JsonObject
from spikeloom.models.recordings.evtouch import Recordings
from spikeloom.runtime.inputs.checkpoint import given_places
from spikeloom.runtime.inputs.network import LoadedNetwork
from spikeloom.runtime.requests.choices import NetworkChoice
from spikeloom.runtime.requests.main_job import CompileRequest

STORED = ("weight_bits", "planes", "scale_groups", "spike_exact", "keep")
"""Options that say how weights are stored."""


def provenance(
    request: CompileRequest, asked: LoadedNetwork, *, calibrated: Recordings | None
) -> Mapping[str, Any]:
    """What a netlist remembers of its compilation, with scales by the recordings `calibrated`, in their own bins."""
    cores_for = parse_cores(request.cores_for)
    return {
        **known_of(request, asked, calibrated),
        **remembered(storage_of(request, asked.network.forms)),
        "spike_exact": request.spike_exact,
        "keep_all": request.keep_all,
        "prune_unused": request.prune_unused,
        **({"share_lists": True} if request.share_lists else {}),
        "calibrated": calibrated is not None,
        **({"cores_for": cores_for} if cores_for else {}),
        **({"chips": request.chips} if request.chips != 1 else {}),
    }


def known_of(request: NetworkChoice, asked: LoadedNetwork, calibrated: Recordings | None) -> JsonObject:
    """What a netlist remembers of its network, and of recordings that trained or `calibrated` it, in their own bins."""
    seen: JsonObject = {}
    if calibrated is not None:
        seen = {"data": calibrated.source, "bin_s": calibrated.bin_s, "class_names": calibrated.names}
    origin = origin_of(asked.training) or origin_of(seen)
    if calibrated is not None and calibrated.events_sha256 != origin.get("train_sha256"):
        origin["calibrated_sha256"] = calibrated.events_sha256
    checkpoint = asked.checkpoint
    places = given_places(request.taxels)
    return {
        "spikeloom": __version__,
        "checkpoint_sha256": asked.sha256,
        **asked.origin(request.run),
        **origin,
        **({"positions_mm": places} if places else {}),
        **({"towers": checkpoint.towers} if checkpoint is not None and checkpoint.towers > 1 else {}),
    }


def whole_numbers(text: str, option: str) -> list[int]:
    """Numbers between commas; OptionError if they are none."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise OptionError(f"{option} {text}: not a number; give one, or several as in 8,4,4,8") from None


def storage_of(request: CompileRequest, forms: Sequence[Form] | None = None) -> Storage:
    """What the options of ``compile`` say about storage; `forms` where a network was fine-tuned for its own.

    OptionError if they are no numbers, contradict each other or ask for what there are no recordings for.
    """
    packings = _packings(request)
    if forms is not None:
        if packings is not None or request.spike_exact:
            omitted = "omit --weight-bits, --planes, --scale-groups and --spike-exact"
            raise OptionError(f"compile: the network has storage of its own; {omitted}")
        return Given(forms)
    _require_held_out(request, chosen=packings is not None or request.spike_exact)
    if request.spike_exact:
        bits = Exact().bits if packings is None else packings[0].bits
        if packings not in (None, (Packing(bits=bits),)):
            raise OptionError(
                "--spike-exact: finds planes and scales itself; give one width, no --planes or --scale-groups"
            )
        return Exact(bits)
    if packings is not None:
        return Fixed(packings)
    if request.calibrate is None:
        return Fixed()
    return Cheapest() if request.keep is None else Cheapest(float(request.keep))


def options_of(storage: Storage, given: Mapping[str, Any]) -> Mapping[str, Any]:
    """The inverse of :func:`storage_of`: options of ``compile``, of which none but these may be `given`, too."""
    others = [name for name in STORED if given[name] is not None and given[name] is not False]
    if others:
        raise OptionError(f"compile: storage and {others[0]} say how weights are stored; give one of them")
    match storage:
        case Cheapest():
            return {"keep": storage.keep}
        case Exact():
            return {"spike_exact": True, "weight_bits": str(storage.bits)}
        case Fixed():
            columns = {"weight_bits": "bits", "planes": "planes", "scale_groups": "groups"}
            return {
                option: ",".join(str(getattr(packing, field)) for packing in storage.packings)
                for option, field in columns.items()
            }
    raise OptionError(f"compile: storage {storage!r}: allowed: Fixed, Cheapest or Exact; give one")


def _require_held_out(request: CompileRequest, *, chosen: bool) -> None:
    """Refuse a share of decisions that is none, or by which nothing can be chosen."""
    keep = request.keep
    if keep is None:
        return
    if not 0 <= keep <= 1:
        raise OptionError(f"--keep {keep:g}: not a share; give a number from 0 to 1")
    if request.calibrate is None:
        raise OptionError(f"--keep {keep:g}: no recordings to hold out; give --calibrate")
    if chosen:
        others = "--weight-bits, --planes, --scale-groups and --spike-exact"
        raise OptionError(f"--keep {keep:g}: chooses storage; omit it, or {others}")


def _packings(request: CompileRequest) -> tuple[Packing, ...] | None:
    """Packing that the options of ``compile`` ask for, or None where they do not.

    Raises OptionError if they are no numbers, or disagree about the number of layers.
    """
    said = {
        "--weight-bits": (request.weight_bits, "8"),
        "--planes": (request.planes, "1"),
        "--scale-groups": (request.scale_groups, "1"),
    }
    if all(words is None for words, _ in said.values()):
        return None
    numbers = {
        option: whole_numbers(usual if words is None else words, option)
        for option, (words, usual) in said.items()
    }
    layers = max(len(values) for values in numbers.values())
    for option, values in numbers.items():
        if len(values) not in (1, layers):
            raise OptionError(
                f"{option}: {len(values)} numbers, another option gives {layers}; give as many, or one"
            )
    columns = [values if len(values) == layers else values * layers for values in numbers.values()]
    return tuple(Packing(bits=b, planes=p, groups=g) for b, p, g in zip(*columns, strict=True))


def remembered(storage: Storage) -> Mapping[str, Any]:
    """What the provenance of a netlist has of its storage, before held-out recordings choose."""
    if isinstance(storage, Given):
        return {"weight_bits": _one_or_list([form.bits for form in storage.forms]), "fine_tuned": True}
    packings: tuple[Packing, ...] = (Packing(),)
    if isinstance(storage, Fixed):
        packings = storage.packings
    if isinstance(storage, Exact):
        packings = (Packing(bits=storage.bits),)
    return {
        "weight_bits": _one_or_list([packing.bits for packing in packings]),
        "planes": _one_or_list([packing.planes for packing in packings]),
        "scale_groups": _one_or_list([packing.groups for packing in packings]),
    }


def _one_or_list(values: list[int]) -> int | list[int]:
    return values[0] if len(set(values)) == 1 else values


def parse_cores(words: str | None) -> dict[str, int]:
    """Least number of cores by layer, from the words of ``--cores-for``.

    >>> parse_cores("conv1=8,fc1=6")
    {'conv1': 8, 'fc1': 6}

    Raises OptionError if they are none.
    """
    if words is None:
        return {}
    cores: dict[str, int] = {}
    for word in words.split(","):
        layer, _, count = word.strip().partition("=")
        if not layer or not (count.isascii() and count.isdecimal()) or int(count) == 0:
            raise OptionError(
                f"--cores-for {words}: {word!r} is not LAYER=N, N from 1; write for example fc1=6"
            )
        if layer in cores:
            raise OptionError(f"--cores-for {words}: names {layer} twice; give it once")
        cores[layer] = int(count)
    return cores

"""Keys of the object that each command prints with ``--json``: scripts rely on them."""

LISTS = """
anytime:
    bins chip_steps decisions files full labelled labels least_interval rules samples savings source split windows
bits:
    combinations command float_accuracy front layers netlist of recommended recordings scale_groups wanted
    widths
chart:
    budget chosen_by command data expected format grid networks points recommended refused saving
    spikeloom tables target
compile:
    chips classes compartments cores layers limits neurons provenance sha256 synapses synapses_nonzero
    synapses_stored target taxels tiles bins? calibration? clocks? core_bound? exactness? facts? layout? path?
    placement? proofs? removals?
compile, crossbars:
    axons classes cores crossing_points drain_ticks feeds layers limits max_crossing_points_of_an_axon neurons
    provenance sha256 target taxels tick_clocks ticks_per_step wires clocks?
data:
    bin_s dead duration_s events found hot labels one_sided picture rate recordings rules source split steps taxels
    unlabelled
estimate:
    chip_steps cores detail energy_by_part_j energy_range_j layers max min not_modelled not_priced pace
    per_inference samples static time
estimate, crossbars:
    cores cores_of_chip energy layers max min not_priced pace per_inference samples static_w
explain:
    causes diagnosis different faults graph layers recording reference roots sample searched split steps top
export netx:
    bytes exact format layers neurons path sha256 synapses
export nir:
    bytes convention dt format neurons path sha256 synapses
export onnx:
    bytes form format inputs neurons outputs path sha256 synapses
export onnx-float:
    bytes form format graph inputs neurons outputs path sha256
export sanafe:
    bytes cores format groups input_cores neurons path sha256 synapses
finetune:
    before command data data_sha256 epochs file fine_tuned_from fine_tuned_weights history last seed sha256
    test_samples weight_bits
inspect checkpoint:
    assumed beta classes given graph layers layout sha256 system taxels theta training bins? dynamics? hops? towers?
inspect checkpoint, crossbars:
    classes clocks copies edges graph layers levels sets sha256 system taxels towers training weights
inspect netlist:
    chips classes compartments cores layers limits neurons provenance sha256 synapses synapses_nonzero
    synapses_stored target taxels tiles bins? clocks?
inspect netlist, crossbars:
    axons classes cores crossing_points drain_ticks feeds layers limits max_crossing_points_of_an_axon neurons
    provenance sha256 target taxels tick_clocks ticks_per_step wires clocks?
join:
    classes command file graph layers sha256 system towers
lean:
    differ layers output overflowing rows samples source split taken taxels
report:
    cores costs decisions netlist output provenance recording taxels verify
run:
    accuracy counts files labelled labels predictions samples
stress:
    classes clean full missed not_applicable perturbations provenance recordings required seeds
train:
    protocols runs
verify:
    accuracy breakdowns certificate decision_agreement engine engine_different first_divergence ladder levels missed
    not_compared quantised_different same_checkpoint samples spec_equals_engine spec_samples spikes weights
verify, crossbars:
    E0 E1 correct exact membranes_saturated samples target spec_steps? sums?
watch bin:
    bins counts decision grasp kind margin time_s
watch end:
    bins events grasps interrupted kind late repeated
watch grasp:
    bins counts decision grasp kind margin time_s
yardsticks:
    arithmetic graph neurobench not_counted prices_pj samples source
"""
"""A command, and its keys; with a question mark those that only some networks have."""


def _tables() -> dict[str, tuple[set[str], set[str]]]:
    tables: dict[str, tuple[set[str], set[str]]] = {}
    for line in LISTS.strip().splitlines():
        if not line.startswith(" "):
            always, sometimes = tables[line.rstrip(":")] = set(), set()
        for word in line.split() if line.startswith(" ") else ():
            (sometimes if word.endswith("?") else always).add(word.rstrip("?"))
    return tables


KEYS = _tables()
"""Of each command those keys that are always there, and those that may be."""

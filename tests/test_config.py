"""Options in a file are those of the command line, which wins; what nothing knows is refused by name."""

import pytest

from spikeloom.runtime.cli import build_parser


def request_of(*words):
    arguments = build_parser(words[0]).parse_args(list(words))
    return arguments.request.of(vars(arguments))


def test_a_file_says_what_is_typed(write):
    path = write(
        "x.toml",
        """
[compile]
checkpoint = "net.pt"
weight-bits = [4, 8, 8, 8]
directed = true
spike-exact = false
keep-all = true
chips = 2
beta = 0.25
polarities-first = true
dump-after = ["expand", "place"]
output = "a.loom"
[chart]
jobs = 3
""",
    )
    typed = [
        "--weight-bits",
        "4,8,8,8",
        "--directed",
        "--keep-all",
        "--chips",
        "2",
        "--beta",
        "0.25",
        "--polarities-first",
    ]
    typed += ["--dump-after", "expand", "--dump-after", "place", "-o", "a.loom"]
    assert request_of("compile", "--config", str(path)) == request_of("compile", "net.pt", *typed)
    wins = request_of("compile", f"--config={path}", "--dump-after", "prune", "-o", "b.loom", "--chip", "1")
    assert (wins.dump_after, wins.output, wins.chips, wins.beta) == (("prune",), "b.loom", 1, 0.25)
    # --keep is no short form of --keep-all, as it is an option of its own
    assert request_of("compile", "--config", str(path), "--keep", "0.5").keep_all
    assert request_of("chart", "n.pt", "--data", "d", "-o", "f", "--config", str(path)).jobs == 3
    assert request_of("compile", "other.pt", "--conf", str(path)).checkpoint == "other.pt"  # shortened
    path.write_bytes("\ufeff[compile]\ncheckpoint = 'marked.pt'\noutput = 'a.loom'".encode())
    assert request_of("compile", "--config", str(path)).checkpoint == "marked.pt"


@pytest.mark.parametrize(
    "words",
    [
        "compile net.pt -o a.loom --polarities-last --weight-bits 4,8 --dump-after prune --keep 0.5",
        "chart a.pt b.pt --data d -o folder --budget energy=1uJ --budget cores=1",
        "data convert x.zip -o ä.zip --join 2",
        "watch net.loom --until-sure",
    ],
)
def test_a_written_file_gives_the_same_request(tmp_path, words):
    from spikeloom.runtime.commands.config import write_config

    arguments = build_parser(words.split()[0]).parse_args(words.split())
    path = str(tmp_path / "x.toml")
    write_config(path, arguments.config_table, arguments.request.of(vars(arguments)))
    command = arguments.config_table.split()
    assert request_of(*command, "--config", path) == arguments.request.of(vars(arguments))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[run]\nsplitt = 'train'", "splitt: no option of run; see spikeloom run --help"),
        ("[run]\nconfig = 'y.toml'", "config: no option of run"),
        ("limit = 3", "limit is in no table; write [run] above it"),
        ("[runn]\nlimit = 3", "[runn] is the table of no command; write [run]"),
        ("[run", "is truncated or damaged"),
        ("[run]\nlimit = 'three'", "argument --limit: invalid int value: 'three'"),
        ("[run]\nlimit = true", "limit = True: allowed: a value"),
        ("[run]\njson = 1", "json = 1: allowed: true or false"),
        ("[run]\nlimit = {a = 1}", "limit: allowed: text, a number, or a list of these"),
    ],
)
def test_what_is_refused(refusal, write, text, words):
    path = write("x.toml", text)
    assert words in refusal("run", "net.loom", "--data", "data", "--config", path)


def test_a_run_writes_its_options(spikeloom, place):
    assert (
        spikeloom("run", "net.loom", "--data", "data", "--limit", "2", "--write-config", "run.toml")[0] == 0
    )
    text = (place / "run.toml").read_text("utf-8")
    assert text == '[run]\nlimit = 2\ndata = "data"\nnetlist = "net.loom"\n'
    assert spikeloom("run", "--config", "run.toml") == spikeloom(
        "run", "net.loom", "--data", "data", "--limit", "2"
    )
    assert "no such file" in spikeloom("run", "--config", "none.toml")[2]
    netlist = (place / "net.loom").read_bytes()
    assert (
        "net.loom: is an input"
        in spikeloom("run", "net.loom", "--data", "data", "--write-config", "net.loom")[2]
    )
    assert (place / "net.loom").read_bytes() == netlist

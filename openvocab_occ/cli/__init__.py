"""`openvocab-occ`: one command for each public verb, loaded only when it is called."""

import sys
from importlib import import_module
from typing import NamedTuple

from openvocab_occ._version import __version__
from openvocab_occ.errors import OpenVocabOccError


class Command(NamedTuple):
    """Where a command lives, and its line in the help."""

    home: str
    summary: str


COMMANDS = {
    "demo": Command("demo:demo", "build, ask, export and show the map of a synthetic street"),
    "city": Command("city:city", "write a made-up town, driven many times, as a nuScenes tree"),
    "map": Command("map:build", "turn a drive and an ONNX model into a map"),
    "find": Command("find:find", "ask a map for things in words"),
    "view": Command("view:view", "show a map in the web browser"),
    "export": Command("export:export", "render a semantic view of a map for a person or a model"),
    "eval grounding": Command("grounding:grounding", "judge answers about the demo city against its truth"),
    "bench query": Command("grounding:bench_query", "time queries against plain matrix products"),
    "eval keyframe": Command("evaluate:keyframe", "judge depth and answers by the LiDAR of a real keyframe"),
}


def _help() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join([
        "usage: openvocab-occ COMMAND [OPTIONS]", "", "Open-vocabulary 3D maps from occupancy.", "", *lines, "",
        "openvocab-occ COMMAND --help tells the options of a command; --json prints one JSON object for programs.",
    ])  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return 0, or 2 for input that cannot be used."""
    words = sys.argv[1:] if arguments is None else arguments
    if not words or words[0] in ("-h", "--help"):
        print(_help())
        return 0
    if words[0] == "--version":
        print(__version__)
        return 0
    name = next((" ".join(words[:n]) for n in (2, 1) if " ".join(words[:n]) in COMMANDS), None)
    if name is None:
        print(f"error: no command {words[0]!r}; openvocab-occ --help lists them", file=sys.stderr)
        return 2
    module, function = COMMANDS[name].home.split(":")
    import tyro

    run = getattr(import_module(f"openvocab_occ.cli.{module}"), function)
    rest = words[name.count(" ") + 1 :]
    try:
        tyro.cli(run, prog=f"openvocab-occ {name}", args=rest, config=(tyro.conf.FlagCreatePairsOff,))
    except OpenVocabOccError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of a pipe had enough
        sys.stdout = None
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    return 0


def script() -> None:
    """Entry point of the console script."""
    sys.exit(main())

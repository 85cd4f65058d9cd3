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
    "demo": Command("demo:demo", "map a drive through the synthetic city, ask it, show it"),
    "city": Command("city:city", "write a made-up town, driven many times, as a nuScenes tree"),
    "doctor": Command("doctor:doctor", "look at a drive before it is mapped, and say what is wrong"),
    "map": Command("map:build", "turn a drive and an ONNX model into a map"),
    "find": Command("find:find", "ask a map for things in words"),
    "objects": Command("objects:objects", "print the things of a map as a tree"),
    "view": Command("view:view", "show a map in the web browser"),
    "export views": Command("export:views", "render semantic views of a map for a person or a model"),
    "export": Command("export:views", "the same"),
    "brief": Command("export:brief", "tell what comes along the way ahead"),
    "mcp": Command("export:mcp", "serve a map to agents over the Model Context Protocol"),
    "eval vlm": Command("vlm:vlm", "judge how a vision-language model reads view bundles"),
    "bench views": Command("bench:views", "time pictures of a map of a million voxels"),
    "eval objects": Command("eval_objects:objects", "judge objects by the truth of the demo city"),
    "eval grounding": Command("grounding:grounding", "judge answers about the demo city against its truth"),
    "bench query": Command("grounding:bench_query", "time queries against plain matrix products"),
    "model probe": Command("model:probe", "look at an ONNX model without a card, and draft one"),
    "model check": Command("model:check", "run the self-test of a model's card"),
    "model bench": Command("model:bench", "time a model"),
    "model show": Command("model:show", "print a model's card"),
    "model calibrate": Command("model:calibrate", "fit probabilities from labelled voxels"),
    "eval segmenter": Command("evaluate:segmenter", "judge a dense model by pixels and words on synthetic streets"),
    "occ train": Command("occ:train", "train an occupancy network, or a memory around one"),
    "occ eval": Command("occ:evaluate", "judge an occupancy network by labels"),
    "occ predict": Command("occ:predict", "predict the occupancy of a drive, with the global map"),
    "memory build": Command("memory:build", "write the occupancy of a drive into the global map"),
    "memory read": Command("memory:read", "read the prior around a place"),
    "memory write": Command("memory:write", "write one window of logits"),
    "memory merge": Command("memory:merge", "put maps into one"),
    "memory diff": Command("memory:diff", "tell what appeared, vanished and changed"),
    "memory info": Command("memory:info", "describe a global map"),
    "memory verify": Command("memory:verify", "find damaged tiles, and mend them from the journal"),
    "memory rebuild": Command("memory:rebuild", "make a map anew, without an agent or by another policy"),
    "memory consolidate": Command("memory:consolidate", "merge drives into the base of a map"),
    "memory prune": Command("memory:prune", "drop journal entries that are folded into the base"),
    "memory export": Command("memory:export", "draw a map, or write its voxels to a file"),
    "crowdsource": Command("crowdsource:crowdsource", "let agents drive concurrently into one map"),
    "eval memory": Command("eval_memory:memory", "show what the global map is good for, on synthetic streets"),
    "bench memory": Command("bench_memory:memory", "measure the global map"),
    "bench fusion": Command("bench_fusion:fusion", "time the fusion of prior and present beside Neural Map Prior's"),
    "eval keyframe": Command("evaluate:keyframe", "judge depth and answers by the LiDAR of a real keyframe"),
    "bench depth": Command("bench:depth", "time depth images beside other ways to them"),
    "bench surface": Command("bench:surface", "judge voxel and smooth depth by three synthetic meshes"),
    "file info": Command("file:info", "say what a map holds"),
    "file verify": Command("file:verify", "check every byte of a map"),
    "file merge": Command("file:merge", "merge two drives of one place"),
    "file diff": Command("file:diff", "say what appeared, vanished or changed between two maps"),
    "file crop": Command("file:crop", "cut a box out of a map"),
    "file concat": Command("file:concat", "put maps that share no voxel together"),
    "file convert": Command("file:convert", "write a map or points in another format"),
    "bench lift": Command("bench:lift", "time the lift beside dense ways"),
    "bench fuse": Command("bench:fuse", "time fusing a long loop"),
    "bench map": Command("bench:map", "time keyframes, RGB-D frames beside object clouds, and size files"),
}


def _help() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join([
        "usage: openvocab-occ COMMAND [OPTIONS]", "", "Open-vocabulary 3D maps from occupancy.", "", *lines, "",
        "openvocab-occ COMMAND --help tells the options of a command; --json prints one JSON object for programs.",
    ])  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return what it returns (0 if nothing), or 2 for input that cannot be used."""
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
        code = tyro.cli(run, prog=f"openvocab-occ {name}", args=rest, config=(tyro.conf.FlagCreatePairsOff,))
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
    return code or 0


def script() -> None:
    """Entry point of the console script."""
    sys.exit(main())

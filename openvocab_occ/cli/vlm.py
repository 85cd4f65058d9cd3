"""`openvocab-occ eval vlm`."""

import os
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from openvocab_occ.cli.output import console, print_json, progress


def vlm(
    bundles: Annotated[list[Path], tyro.conf.Positional],
    *,
    endpoint: str,
    model: str = "default",
    key_variable: str = "",
    leave_out: tuple[str, ...] = (),
    no_blind: bool = False,
    timeout: float = 120.0,
    json: bool = False,
) -> None:
    """Judge how well a vision-language model reads view bundles, by questions whose answers the map knows.

    The pictures and words of the bundles are sent to the endpoint, once for each question.

    Args:
        bundles: Folders of `export views`, or folders that hold several.
        endpoint: Base address of an OpenAI-compatible service, such as http://127.0.0.1:8000/v1.
        model: Name of the model there.
        key_variable: Environment variable that holds the service's key, if it needs one.
        leave_out: What the model is not shown: pictures, marks, bev, table.
        no_blind: Do not also ask without showing anything.
        timeout: Seconds to wait for a reply.
        json: Print one JSON object.
    """
    from openvocab_occ.errors import ConfigError
    from openvocab_occ.evaluation.vlm import Shown, judge, questions_of, summarize
    from openvocab_occ.export.views import ViewBundle
    from openvocab_occ.query.llm import LanguageModel

    if not set(leave_out) <= {"pictures", "marks", "bev", "table"}:
        raise ConfigError("this cannot be left out", expected="pictures, marks, bev or table", got=leave_out)
    if key_variable and key_variable not in os.environ:
        raise ConfigError("no such environment variable", expected="one with the key", got=key_variable)
    key = os.environ[key_variable] if key_variable else ""
    service = LanguageModel(url=endpoint, model=model, key=key, timeout=timeout)
    opened = [ViewBundle.open(folder) for path in bundles for folder in _folders(path)]
    questions = [q for bundle in opened for q in questions_of(bundle)]
    shown = Shown(**dict.fromkeys(leave_out, False))
    ways = {shown.name: shown} | ({} if no_blind else {"blind": None})
    scores, readings = {}, {}
    for name, what in ways.items():
        with progress(f"asking, {name}", unit="bundles") as advance:
            readings[name] = []
            for done, bundle in enumerate(opened, start=1):
                readings[name] += judge(bundle, service, shown=what)
                advance(done, len(opened))
        scores[name] = summarize(readings[name], questions)
    synthetic = any(bundle.view["provenance"]["synthetic"] for bundle in opened)
    if json:
        told = {name: {kind: asdict(score) for kind, score in kinds.items()} for name, kinds in scores.items()}
        facts = {"model": model, "bundles": len(opened), "questions": len(questions), "synthetic": synthetic}
        print_json({**facts, "scores": told, "readings": {n: [asdict(r) for r in rs] for n, rs in readings.items()}})
        return
    out = console()
    out.print(f"{model}: {len(questions)} questions about {len(opened)} bundles{' (synthetic)' if synthetic else ''}")
    table = Table("kind", "questions", "chance", *ways, "no answer", box=None, pad_edge=False)
    first = next(iter(scores.values()))
    for kind, score in first.items():
        shares = [f"{kinds[kind].correct:.0%}" for kinds in scores.values()]
        table.add_row(kind, str(score.questions), f"{score.chance:.0%}", *shares, f"{score.unread:.0%}")
    out.print(table)


def _folders(path: Path) -> list[Path]:
    """Return a bundle's folder, or those of the bundles in a folder of several."""
    if (path / "views.json").is_file():
        return sorted(folder for folder in path.iterdir() if (folder / "view.json").is_file())
    return [path]

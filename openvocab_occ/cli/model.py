"""`openvocab-occ model probe|check|bench|show|calibrate`."""

from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

from openvocab_occ.cli.output import console, print_json
from openvocab_occ.errors import AlreadyExistsError, ConfigError, ModelError

Model = Annotated[Path, tyro.conf.Positional]


def probe(model: Model, *, out: Path | None = None, json: bool = False) -> None:
    """Look at a model that has no card: what it declares, what a run shows; draft its card.

    Args:
        model: An ONNX file.
        out: Write the draft here, such as MODEL.card.yaml; a file that is there is kept.
        json: Print one JSON object.
    """
    from openvocab_occ.segmentation.probe import probe as look

    if out is not None and out.exists():
        raise AlreadyExistsError(f"{out} exists", expected="a new file", fix="choose another name")
    found = look(model)
    if out is not None:
        if not found.draft:
            raise ModelError(
                f"{model.name} gives no draft", expected="a model of one image", got="; ".join(found.notes)
            )
        out.write_text(found.draft)
    if json:
        names = ("sha256", "inputs", "outputs", "card", "notes", "draft", "shapes")
        print_json({"model": str(model), **{name: getattr(found, name) for name in names}})
        return
    say = console()
    say.print(f"[bold]{model}[/bold]  {model.stat().st_size / 1e6:.2f} MB, sha256 {found.sha256[:16]}...")
    for what, ports in (("in", found.inputs), ("out", found.outputs)):
        for port in ports:
            say.print(f"  {what:<4}{port}", markup=False)
    for name, shape in found.shapes.items():
        say.print(f"  ran {name}: {' x '.join(map(str, shape))}", markup=False)
    for note in found.notes:
        say.print(f"  {note}", markup=False)
    say.print(f"  card: {found.card or 'none'}", markup=False)
    if found.draft:
        say.print(f"\n{found.draft}" if out is None else f"  draft: {out}", markup=False, soft_wrap=True)


def check(model: Model, *, card: Path | None = None, sandbox: bool = False, json: bool = False) -> None:
    """Run the self-test of a card: do the numbers of the model's makers come out here?

    Args:
        model: An ONNX file.
        card: Its card, if it does not lie beside it.
        sandbox: Run the model in a child process with limited memory.
        json: Print one JSON object.
    """
    from openvocab_occ.segmentation.onnx import load_encoder
    from openvocab_occ.segmentation.selftest import check as compare

    encoder = load_encoder(model, card, sandbox=sandbox)
    results = compare(encoder, getattr(_card(model, card), "selftest", None))
    passed = all(result.passed for result in results)
    rows = [{"what": r.what, "off": r.off, "passed": r.passed} for r in results]
    if json:
        print_json({"model": str(model), "passed": passed, "checks": rows})
    else:
        for result in results:
            console().print(
                f"{'ok  ' if result.passed else 'BAD '} {result.what}: off by {result.off:.4f}", markup=False
            )
    if not passed:
        raise ModelError(
            f"{model.name} does not give the numbers of its card",
            expected="differences within the tolerance",
            got="; ".join(f"{r.what} off by {r.off:.3g}" for r in results if not r.passed),
            fix="compare mean, std, range, color, padding and case with the model's makers",
        )


def bench(
    model: Model,
    *,
    card: Path | None = None,
    size: tuple[int, int] = (256, 704),
    batch: int = 1,
    runs: int = 20,
    threads: int | None = None,
    provider: str = "cpu",
    json: bool = False,
) -> None:
    """Time a model, with all that happens to an image before and after it.

    Args:
        model: An ONNX file.
        card: Its card, if it does not lie beside it.
        size: Height and width of the images.
        batch: Images a call.
        runs: Timed calls, after three that are not.
        threads: Of onnxruntime; all cores by default.
        provider: cpu, cuda or tensorrt.
        json: Print one JSON object.
    """
    from openvocab_occ.segmentation.benchmark import bench as measure

    report = measure(model, card, size=size, batch=batch, runs=runs, threads=threads, providers=(provider,))
    if json:
        print_json(report)
        return
    say = console().print
    say(f"[bold]{model}[/bold]  {report['batch']} x {size[1]} x {size[0]} on {report['provider']}, "
        f"{report['threads'] or 'all'} threads, {report['machine']}")  # fmt: skip
    say(f"  image to cells  {report['ms_median']:.1f} ms median, {report['ms_best']:.1f} best, an image")
    if report["text_ms_median"] is not None:
        say(f"  text            {report['text_ms_median']:.2f} ms a query")
    say(f"  cells           {' x '.join(map(str, report['cells']))}, loaded in {report['load_ms']:.0f} ms")


def show(model: Model, *, card: Path | None = None, json: bool = False) -> None:
    """Print a card as a person reads it.

    Args:
        model: An ONNX file, or a card.
        card: The card, if it does not lie beside the model.
        json: Print one JSON object.
    """
    import msgspec

    found = _card(model, card)
    fields: dict[str, Any] = msgspec.to_builtins(found)
    if json:
        print_json(fields)
        return
    from openvocab_occ.segmentation.sentences import sentences

    table = Table(box=None, show_header=False, pad_edge=False)
    for topic, text in sentences(found):
        table.add_row(f"[bold]{topic}[/bold]", text)
    console().print(table)


def calibrate(
    map: Annotated[Path, tyro.conf.Positional],
    labels: Annotated[Path, tyro.conf.Positional],
    *,
    encoder: Path,
    card: Path | None = None,
    dataset: str,
    json: bool = False,
) -> None:
    """Fit what turns a cosine into a probability, from labelled voxels of a map, and write it into the card.

    Args:
        map: A saved map of a dense model, NAME.ovmap.
        labels: A .npz with `points` (n, 3: world coordinates, metres) and `names` (n: the word that is true there).
        encoder: The ONNX model that made the map.
        card: Its card, if it does not lie beside it; it is rewritten.
        dataset: Name of the labels' source, written into the card.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.calibration import calibrate_card
    from openvocab_occ.objects.scene_map import SceneMap

    path = card or encoder.with_suffix(".card.yaml")
    if not path.is_file():
        raise ConfigError("there is no card to write to", expected=str(path), fix="pass card=")
    fitted = calibrate_card(SceneMap.open(map), labels, encoder, path, dataset=dataset)
    report = {"card": str(path), "a": fitted.a, "b": fitted.b, "voxels": fitted.count, "date": fitted.date,
              "dataset": fitted.dataset}  # fmt: skip
    if json:
        print_json(report)
    else:
        console().print(f"{path}: probability = sigmoid({fitted.a:.2f} cosine + {fitted.b:.2f}), "
                        f"from {fitted.count:,} voxel-word pairs of {fitted.dataset}", markup=False)  # fmt: skip


def _card(model: Path, card: Path | None) -> Any:
    from openvocab_occ.segmentation.card_files import find_card, read_card
    from openvocab_occ.segmentation.session import Session

    if card is not None or model.suffix in (".yaml", ".yml", ".json"):
        return read_card(card or model)
    beside = model.with_suffix(".card.yaml")
    return read_card(beside) if beside.is_file() else find_card(model, Session(model).embedded_card)[0]

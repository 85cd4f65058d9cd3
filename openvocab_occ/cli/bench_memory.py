"""`openvocab-occ bench memory`."""

import tempfile
from pathlib import Path

from openvocab_occ.cli.output import console, print_json


def memory(
    *, frames: int = 24, repeats: int = 7, updates: int = 60, kills: int = 5, folder: Path | None = None,
    json: bool = False,
) -> None:  # fmt: skip
    """Measure the tile map against plain work on the same bytes, and count what fights and kills lose.

    Args:
        frames: Keyframes of the made-up drive, 5 m apart.
        repeats: Of which the median counts.
        updates: By three processes into the same chunks.
        kills: Of a writing process, at random moments.
        folder: Where to write; a temporary folder by default.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.memory_bench import bench

    with tempfile.TemporaryDirectory(prefix="openvocab_occ-", dir=folder) as scratch:
        report = bench(Path(scratch), frames=frames, repeats=repeats, updates=updates, kills=kills)
    if json:
        print_json(report)
        return
    w, k = report["writers"], report["kills"]
    lines = (
        f"window, cached   {report['window_cached_ms']:8.1f} ms  {report['window_cached_ratio']:.2f} x numpy's",
        f"window, cold     {report['window_cold_ms']:8.1f} ms  {report['window_cold_ratio']:.2f} x decoding its chunks",
        f"  and numpy's gather        {report['window_cold_ratio_to_files_and_gather']:.2f} x",
        f"  decoding and zeros alone  {report['window_floor_ratio_to_files']:.2f} x decoding its chunks",
        f"durable update   {report['update_ms']:8.1f} ms  {report['update_ratio']:.2f} x the same files, fsynced",
        f"  and journal    {report['journaled_update_ms']:8.1f} ms  {report['journaled_update_ratio']:.2f} x",
        f"  eight at a time {report['update_ms_in_batches_of_8']:7.1f} ms each",
        f"storage          {report['gb_per_km2_of_tiles']:8.3f} GB/km² of tiles, "
        f"{report['gb_per_km2_of_known_ground']:.3f} of known ground; dense {report['dense_float32_gb_per_km2']:.2f}",
        f"labels changed   {report['argmax_changed']:8.4%}, probabilities by {report['worst_probability_error']:.4f}",
        f"three writers    {w['lost']} of {w['updates']} updates lost, {w['unreadable']} unreadable",
        f"{k['kills']} kills          {k['lost']} of {k['acknowledged']} updates lost, {k['unreadable']} unreadable",
        "(synthetic data)",
    )
    console().print("\n".join(lines), markup=False)

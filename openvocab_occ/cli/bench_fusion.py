"""`openvocab-occ bench fusion`."""

from openvocab_occ.cli.output import console, print_json


def fusion(
    *, channels: int = 256, cells: int = 200, repeats: int = 5, bf16: bool = False, device: str = "cpu",
    compiled: bool = False, kernel: int = 3, json: bool = False,
) -> None:  # fmt: skip
    """Time Current-Prior Fusion beside Neural Map Prior's attention and recurrent unit, in one run.

    Args:
        channels: Of the features.
        cells: Along a side of the ground.
        repeats: Of which the median counts.
        bf16: Work in bfloat16.
        device: cpu or cuda.
        compiled: By torch.compile.
        kernel: Of CPFusion's convolutions, which the paper does not tell: 3 or 1.
        json: Print one JSON object.
    """
    from openvocab_occ.evaluation.fusion_bench import bench

    report = bench(channels=channels, cells=cells, repeats=repeats, bf16=bf16, device=device, compiled=compiled,
                   kernel=kernel)  # fmt: skip
    if json:
        print_json(report)
        return
    lines = [
        f"{name:<9} {report[name]['ms']:8.1f} ms  {report[name]['cpu_ms']:8.1f} ms of processor time  "
        f"{report[name]['parameters'] / 1e6:.2f} M parameters  {report[name]['gflop']:.0f} GFLOP"
        for name in ("cpfusion", "nmp")
    ]
    ratio = f"ratio {report['ratio']:.2f} (wall {report['ratio_wall']:.2f}); the paper's {report['paper_ratio']}"
    console().print("\n".join([*lines, ratio]), markup=False)

"""Current-Prior Fusion against Neural Map Prior's fusion: time, parameters, operations (LMPOcc's Table IV)."""

import statistics
import time
from typing import Any


def bench(*, channels: int = 256, cells: int = 200, repeats: int = 5, bf16: bool = False, device: str = "cpu",
          compiled: bool = False, kernel: int = 3) -> dict[str, Any]:  # fmt: skip
    """Time both on the same features, channels last, taking turns; medians and their ratio."""
    import torch

    from openvocab_occ.networks.flashocc import count_parameters
    from openvocab_occ.networks.fusion import CurrentPriorFusion, NeuralMapPriorFusion

    torch.manual_seed(0)
    kind = torch.bfloat16 if bf16 else torch.float32
    current, prior = (
        torch.randn(1, channels, cells, cells, device=device, dtype=kind).contiguous(memory_format=torch.channels_last)
        for _ in range(2)
    )
    rivals = {"cpfusion": CurrentPriorFusion(channels, kernel=kernel), "nmp": NeuralMapPriorFusion(channels)}
    ways = {
        name: module.to(device, kind).to(memory_format=torch.channels_last).eval()  # pyright: ignore[reportCallIssue]
        for name, module in rivals.items()
    }
    run = {name: torch.compile(module) if compiled else module for name, module in ways.items()}
    wall: dict[str, list[float]] = {name: [] for name in ways}
    busy: dict[str, list[float]] = {name: [] for name in ways}
    with torch.inference_mode():
        for turn in range(repeats + 1):
            for name, module in run.items():
                if device != "cpu":
                    torch.cuda.synchronize()
                started, used = time.perf_counter(), time.process_time()
                module(current, prior)
                if device != "cpu":
                    torch.cuda.synchronize()
                if turn:  # the first one warms up
                    wall[name].append(time.perf_counter() - started)
                    busy[name].append(time.process_time() - used)
    report: dict[str, Any] = {
        "shape": [1, channels, cells, cells], "dtype": str(kind).removeprefix("torch."), "device": device,
        "threads": torch.get_num_threads(), "compiled": compiled, "kernel": kernel, "repeats": repeats,
    }  # fmt: skip
    for name, module in ways.items():
        report[name] = {
            "ms": round(1e3 * statistics.median(wall[name]), 1),
            "cpu_ms": round(1e3 * statistics.median(busy[name]), 1),
            "parameters": count_parameters(module), "gflop": round(_gflop(module, channels, cells, kernel), 1),
        }  # fmt: skip
    clock = "ms" if device != "cpu" else "cpu_ms"
    report["ratio"] = round(report["cpfusion"][clock] / report["nmp"][clock], 3)
    report["ratio_wall"] = round(report["cpfusion"]["ms"] / report["nmp"]["ms"], 3)
    report["paper_ratio"] = 0.61
    return report


def _gflop(module: object, channels: int, cells: int, kernel: int) -> float:
    """Return multiplications and additions, from the definitions: convolutions, and for attention its linear layers."""
    area = cells * cells
    if type(module).__name__ == "CurrentPriorFusion":
        return 2 * area * kernel**2 * channels**2 * 5 / 1e9  # 2C to C, C to C, 2C to C
    gru = 3 * 2 * 9 * channels**2
    attention = 4 * channels**2 + 2 * 100 * channels  # query, key, value, out; 10 x 10 windows
    return 2 * area * (gru + attention) / 1e9

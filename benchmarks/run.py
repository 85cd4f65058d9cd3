"""Time the stages of mapping the synthetic street: seconds a frame, median over the drive.

Usage: python benchmarks/run.py
"""

import datetime
import platform
import statistics
import time
from collections.abc import Callable

from openvocab_occ._jit import num_threads
from openvocab_occ.datasets.registry import load_sequence
from openvocab_occ.depth.render import render_depth
from openvocab_occ.pipeline.build import MapBuilder
from openvocab_occ.segmentation.demo_models import street_model
from openvocab_occ.segmentation.onnx import load_encoder


def seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def main() -> None:
    frames = list(load_sequence("street"))
    encoder = load_encoder(street_model())
    builder = MapBuilder(encoder)
    stages: dict[str, list[float]] = {"depth": [], "segmenter": [], "depth, segmenter, lift and fuse": []}
    for frame in frames:
        cameras = [view.camera for view in frame.views]
        stages["depth"].append(seconds(lambda c=cameras, g=frame.occupancy: render_depth(g, c)))
        stages["segmenter"].append(seconds(lambda f=frame: encoder.encode([view.image for view in f.views])))
        stages["depth, segmenter, lift and fuse"].append(seconds(lambda f=frame: builder.integrate(f)))
    view = frames[0].views[0].camera
    print(f"synthetic street: {len(frames)} frames of {len(frames[0].views)} views of {view.width} x {view.height}, "
          f"{num_threads()} threads, {platform.machine()}, {datetime.date.today()}")  # fmt: skip
    for stage, times in stages.items():
        print(f"  {stage:<32} {statistics.median(times) * 1e3:8.1f} ms a frame")
    print(f"  {'objects and snapshot':<32} {seconds(builder.snapshot) * 1e3:8.1f} ms")


if __name__ == "__main__":
    main()

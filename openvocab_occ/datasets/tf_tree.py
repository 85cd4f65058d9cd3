"""A tree of moving frames, as ROS keeps it."""

import numpy as np
from jaxtyping import Float

from openvocab_occ.errors import DataError, NotFoundError
from openvocab_occ.geometry import Trajectory, invert


class TransformTree:
    """Collects T_parent_child over time; asked for the pose of any frame in any other at any moment."""

    def __init__(self, *, tolerance: float) -> None:
        """Begin with no frames.

        Args:
            tolerance: Seconds by which a moment may lie outside the recorded time of a link. Within it, poses are
                interpolated whatever the gap.
        """
        self.tolerance = tolerance
        self._static: dict[str, tuple[str, np.ndarray]] = {}
        self._moving: dict[str, tuple[str, list[float], list[np.ndarray]]] = {}
        self._trajectories: dict[str, Trajectory] = {}

    def add(self, parent: str, child: str, time: float | None, T_parent_child: Float[np.ndarray, "4 4"]) -> None:
        """Add a pose of a link; a time of None means for ever."""
        if time is None:
            self._static[child] = (parent, T_parent_child)
            return
        known, times, poses = self._moving.setdefault(child, (parent, [], []))
        if known != parent:
            raise DataError(f"TF frame {child!r} has two parents", expected=known, got=parent)
        times.append(time)
        poses.append(T_parent_child)
        self._trajectories.pop(child, None)

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        links = {**{c: p for c, (p, _) in self._static.items()}, **{c: p for c, (p, _, _) in self._moving.items()}}
        return sorted({*links, *links.values()})

    def pose(self, target: str, source: str, time: float) -> Float[np.ndarray, "4 4"]:
        """Return T_target_source at a time.

        Raises:
            NotFoundError: The two are not connected, or a link of the way has no pose near that time.
        """
        root_of_source, T_root_source = self._to_root(source, time, stop=target)
        if root_of_source == target:
            return T_root_source
        root_of_target, T_root_target = self._to_root(target, time, stop=source)
        if root_of_target == source:
            return invert(T_root_target)
        if root_of_source != root_of_target:
            raise NotFoundError(
                f"TF does not connect {source!r} with {target!r}",
                expected="frames of one tree",
                got=f"frames {', '.join(self.frames) or 'none'}",
                fix="name the frames: world=, ego=",
            )
        return invert(T_root_target) @ T_root_source

    def _to_root(self, frame: str, time: float, *, stop: str) -> tuple[str, Float[np.ndarray, "4 4"]]:
        """Walk up to the root, or to `stop` where it is on the way."""
        T = np.eye(4)
        seen = {frame}
        while frame != stop:
            link = self._link(frame, time)
            if link is None:
                break
            frame, T = link[0], link[1] @ T
            if frame in seen:
                raise DataError(f"TF frames form a ring at {frame!r}", expected="a tree")
            seen.add(frame)
        return frame, T

    def _link(self, child: str, time: float) -> tuple[str, Float[np.ndarray, "4 4"]] | None:
        if child in self._static:
            return self._static[child]
        if child not in self._moving:
            return None
        parent, times, poses = self._moving[child]
        if child not in self._trajectories:
            self._trajectories[child] = Trajectory(times, np.array(poses), f"TF of {child!r} in {parent!r}")
        return parent, self._trajectories[child].at(time, tolerance=self.tolerance)

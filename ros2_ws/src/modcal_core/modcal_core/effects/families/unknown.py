"""Errors that have no name yet: any free shape of any driver, at the place where it explains most.

They are the last resort: where a named cause explains nearly as much, the named one is taken.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import ACROSS, ALL, AXIS, SHIFT, Effect
from modcal_core.effects.family import FREE, Family
from modcal_core.effects.registry import base_and_tool, followed, moving_joints, signals
from modcal_core.effects.shapes import Settings, Shape, ShapeKind
from modcal_core.geometry import Array
from modcal_core.robots import is_serial_arm, tool_frames

NAME = "unknown"
SMOOTH = 7  # functions in a smooth curve
DEGREE = 3.0  # of a curve over a signal
WAVES = 3  # a turn, of what stands for effects that nobody named
ORDER = 2.0  # turns of two joints together
STATIONS_PER_FUNCTION = 2.5  # an amplitude of a free shape needs more than two, or it follows single stations


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Curves over the position of one joint, over those of two, and over any recorded signal."""
    yield from _of_position(drivers)
    yield from _of_two_positions(drivers)
    yield from _of_commands(drivers)
    yield from _of_signals(drivers)


def constants(drivers: Drivers) -> Iterator[Effect]:
    """Constant errors of base, tool and joints: geometry, which a fit takes up and a frozen model does not."""
    for place in ("base", "tool"):
        yield Effect(NAME, place, ALL, "constant", Shape("linear"))
    for name in drivers.arm.chain.names:
        yield Effect(NAME, name, AXIS, "constant", Shape("linear"))


def functions(drivers: Drivers, tool: Array) -> tuple[Effect, ...]:
    """For every joint what effects that nobody named may look like, of no size yet: waves, the direction of approach,
    and torque and moment of weight.
    """
    out, chain = [], drivers.arm.chain
    for j, joint in enumerate(chain.names):
        along = [(AXIS, f"position:{joint}", Shape("turn", {"cycles": float(k)})) for k in range(1, WAVES + 1)]
        if (drivers.samples.approach[:, j] != 0.0).any():
            along.append((AXIS, f"direction:{joint}", Shape("sign")))
        if is_serial_arm(chain):
            along.append((AXIS, f"{'load' if drivers.arm.weighed else 'payload'}:{joint}", Shape("linear")))
            if drivers.arm.weighed:  # bearings bend as well as gears
                along.append((ACROSS, f"moment:{joint}", Shape("linear")))
        for direction, driver, shape in along:
            out.append(Effect(NAME, joint, direction, driver, shape, np.zeros(shape.size), np.zeros(shape.size)))
    driver = f"tool:{';'.join(map(repr, tool.tolist()))}"
    at = drivers.values(driver)
    middle, size = at.mean(axis=1), float(np.sqrt(at.var(axis=1).sum()))
    settings = {**dict(zip("xyz", middle.tolist(), strict=True)), "size": max(size, 1e-3)}
    return (*out, Effect(NAME, "base", SHIFT, driver, Shape("warp", settings), np.zeros(27), np.zeros(27)))


def place(drivers: Drivers, tool: str) -> Array:
    """Where the tool is as seen from the root (3, N) [m], the middle where a robot cannot be. tool: in the tip [m]."""
    T = np.eye(4)
    T[:3, 3] = [float(x) for x in tool.split(";")]
    p = tool_frames(drivers.arm.chain, T, drivers.samples.q).p[-1]
    return np.where(np.isfinite(p), p, np.nanmean(p, axis=1, keepdims=True))


def warp(x: Array, s: Settings) -> Array:
    """Coordinates (3, N) about a middle, in a size, and their squares and products (9, N)."""
    u = (x - np.array([[s["x"]], [s["y"]], [s["z"]]])) / s["size"]
    return np.concatenate([u, u * u, u * np.roll(u, 1, axis=0)])


def _of_position(drivers: Drivers) -> Iterator[Effect]:
    """Any smooth dependence of a joint, or of the tilt of its axis, on the position of any joint."""
    for i, driver in moving_joints(drivers):
        low, high = float(drivers.samples.q[:, i].min()), float(drivers.samples.q[:, i].max())
        shape = Shape("spline", {"low": low, "high": high, "count": float(SMOOTH)})
        for name in drivers.arm.chain.names:
            yield Effect(NAME, name, AXIS, f"position:{driver}", shape)
            yield Effect(NAME, name, ACROSS, f"position:{driver}", shape)


def _of_two_positions(drivers: Drivers) -> Iterator[Effect]:
    """Any smooth dependence of a joint on the positions of two joints together."""
    shape = Shape("waves", {"order": ORDER})
    if drivers.samples.stations < STATIONS_PER_FUNCTION * shape.size:
        return
    moving = [name for _, name in moving_joints(drivers)]
    for name in drivers.arm.chain.names:
        for a, first in enumerate(moving):
            for second in moving[a + 1 :]:
                # the joint itself is named first, where it is one of the two
                pair = (second, first) if second == name else (first, second)
                yield Effect(NAME, name, AXIS, f"position:{pair[0]},position:{pair[1]}", shape)


def _of_commands(drivers: Drivers) -> Iterator[Effect]:
    """A joint that errs with how far it is from its command, in whatever way."""
    for j, name in enumerate(drivers.arm.chain.names):
        if followed(drivers, j):
            yield Effect(NAME, name, AXIS, f"following:{name}", Shape("linear"))


def _of_signals(drivers: Drivers) -> Iterator[Effect]:
    """Any recorded number that the error correlates with, whatever its topic."""
    places = [*base_and_tool(drivers), *((name, AXIS) for name in drivers.arm.chain.names)]
    for signal in signals(drivers, temperatures=False):
        x = drivers.values(signal)
        if np.ptp(x) <= 1e-12:
            continue
        bent = Shape("polynomial", {"degree": DEGREE, "low": float(x.min()), "high": float(x.max())})
        for place, direction in places:
            yield Effect(NAME, place, direction, signal, Shape("linear"))
            if direction == AXIS:
                yield Effect(NAME, place, direction, signal, bent)


FAMILY = Family(
    NAME,
    candidates,
    complexity=lambda _: FREE,  # whatever has a name is plainer
    shapes={"warp": ShapeKind(warp, 9)},
    drivers={"tool": place},
)

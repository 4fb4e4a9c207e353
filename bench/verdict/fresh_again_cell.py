"""The second fresh group, continued: what bolts, tools, descriptions and a second recording do."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from case import Case, calibrated, frozen
from conventions import UNIT
from fresh_again import again
from physics import LOAD, centres, scaled, tilted
from regimes import BASE, EITHER, LEFT_OUT, TOOL
from workcell import PERIOD, Array, Works, from_, joined


@again
def base_bolts_slip(w: Works, rng: np.random.Generator) -> Case:
    """The base's bolts hold up to some moment; beyond it the base slips, and stays where it slipped to."""
    q, again = w.postures(160)
    com = centres(w, q)
    moment = np.stack([-com[:, 1], com[:, 0], np.zeros(len(q))], axis=1)
    hold = 0.6 * float(np.std(moment[:, :2]))
    held, states = np.zeros(3), []
    for m in moment:
        held = np.clip(held, m - hold, m + hold)
        states.append(held)
    turn = scaled(np.array(states), 4e-4) * np.array(states)
    return calibrated(w.observe(q, again, tilted(w, lambda s: turn)), (*BASE, w.names[0], w.arm.parents[0], *LOAD))


@again
def forklift_passes(w: Works, rng: np.random.Generator) -> Case:
    """While a forklift stands beside the cell, for ten stations, the floor is down by some tenths of a millimetre."""
    k = int(rng.integers(30, 110))

    def while_(stations) -> Array:  # type: ignore[no-untyped-def]
        return (np.arange(len(stations.t)) >= k) & (np.arange(len(stations.t)) < k + 10)

    words = (*BASE, *LEFT_OUT, r"\btime\b", r"\border\b", r"stations \d")
    return calibrated(w.clean(160, w.base(w.way(3e-4), w.way(1e-4), while_)), words)


@again
def lunch_break(w: Works, rng: np.random.Generator) -> Case:
    """An arm without sensors grows while it warms up, cools over lunch, and grows again."""
    noon = 80 * PERIOD + 1800.0

    def grows(begin: float):  # type: ignore[no-untyped-def]
        def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
            deviation.x[:, 2, 0] += 6e-4 * (1.0 - np.exp(-(stations.t - begin) / 120.0))

        return bend

    session = joined(w.clean(80, grows(0.0)), w.clean(80, grows(noon), begin=noon))
    near = (w.names[1], w.names[2], w.arm.parents[2])
    return calibrated(session, (r"\btime\b", r"\border\b", "drift", "thermal", "warm", *near))


# --- tools -----------------------------------------------------------------------------------------------------------


@again
def tool_changer_reseats(w: Works, rng: np.random.Generator) -> Case:
    """Every twenty stations the tool is put down and taken again: each time it sits a little elsewhere."""
    shift, turn = rng.normal(0, 1.5e-4, (8, 3)), rng.normal(0, 3e-4, (8, 3))

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        seat = np.minimum(np.arange(len(stations.t)) // 20, 7)
        deviation.tool[:, :3] += shift[seat]
        deviation.tool[:, 3:] += turn[seat]

    return calibrated(w.clean(160, bend), (*TOOL, r"\border\b", r"\btime\b", r"\bstep", *w.names[-1:]))


@again
def magnet_mount_slips(w: Works, rng: np.random.Generator) -> Case:
    """A target on a magnet slides down its plate a little in each posture in which the plate stands upright."""
    q, again = w.postures(150)
    _, R = w.arm.frames(w.arm.coordinates(q))
    tool = R[:, -1] @ w.cell.tool[1].as_matrix()
    slid = np.cumsum(np.clip(-tool[:, 2, :2], -1.0, 1.0), axis=0)
    slid *= 5e-4 / np.abs(slid).max()

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tool[:, :2] += slid

    return calibrated(w.observe(q, again, bend), (*TOOL, *w.arm.hand, w.names[-1]))


# --- descriptions and command lines ----------------------------------------------------------------------------------


@again
def description_of_the_left_arm(w: Works, rng: np.random.Generator) -> Case:
    """The URDF is that of the left arm, a mirror image of the right one that was measured."""
    session = w.clean(130)

    def values(found: re.Match[str], sign: tuple[float, ...]) -> str:
        return f'{found[1]}"{" ".join(f"{a * float(v):.12g}" for a, v in zip(sign, found[2].split(), strict=True))}"'

    def mirrored(joint: re.Match[str]) -> str:
        text = re.sub(r'(<origin [^>]*?xyz=)"([^"]*)"', lambda f: values(f, (1.0, -1.0, 1.0)), joint[0])
        text = re.sub(r'(<origin [^>]*?rpy=)"([^"]*)"', lambda f: values(f, (-1.0, 1.0, -1.0)), text)
        return re.sub(r'(<axis xyz=)"([^"]*)"', lambda f: values(f, (-1.0, 1.0, -1.0)), text)

    urdf = re.sub(r"<joint .*?</joint>", mirrored, session.urdf, flags=re.DOTALL)
    assert urdf != session.urdf
    return calibrated(replace(session, urdf=urdf), ("mirror", "handed", "URDF", "description"))


@again
def rpy_of_a_joint_in_degrees(w: Works, rng: np.random.Generator) -> Case:
    """Somebody edited the URDF and wrote the angles of one joint in degrees."""
    session = w.clean(130)
    blocks = [(n, re.search(rf'<joint name="{n}".*?</joint>', session.urdf, re.DOTALL)) for n in w.names[1:]]
    turned = [
        (name, block[0])
        for name, block in blocks
        if block and any(abs(float(v)) > 0.1 for v in re.search(r'rpy="([^"]*)"', block[0])[1].split())  # type: ignore[index]
    ]
    name, block = turned[int(rng.integers(len(turned)))]
    angles = re.search(r'rpy="([^"]*)"', block)[1]  # type: ignore[index]
    degrees = " ".join(f"{np.degrees(float(v)):.9g}" for v in angles.split())
    urdf = session.urdf.replace(block, block.replace(f'rpy="{angles}"', f'rpy="{degrees}"'))
    i = w.names.index(name)
    return calibrated(replace(session, urdf=urdf), (w.names[i - 1], name, "degree"))


@again
def tip_before_the_last_joint(w: Works, rng: np.random.Generator) -> Case:
    """--tip names the link before the last joint, and the tool turns with that joint."""
    words = (w.names[-1], r"\btip\b", *TOOL, w.arm.links[-1])
    return calibrated(w.clean(130), words, "--tip", w.arm.links[-2])


@again
def encoder_resolution_stated_as_repeatability(w: Works, rng: np.random.Generator) -> Case:
    """An arm that repeats to a tenth of a millimetre, of which the resolution of its encoders was stated."""
    session = w.clean(150, returns=0, repeat=8e-5)
    options = ("--repeatability-mm", "0.002", "--instrument-mm", "0.035")
    options += ("--repeatability-deg", "0.0002", "--instrument-deg", "0.002")
    return calibrated(session, ("stated", "repeatab", r"\bfloor\b"), *options, floor=False)


@again
def two_robots_joined(w: Works, rng: np.random.Generator) -> Case:
    """--also a recording that was made after the arm had been exchanged for its spare; base and tool are the same."""
    spare = Works(w.robot, np.random.default_rng(rng.integers(1 << 30)))
    spare.cell.tool, spare.cell.tracker = w.cell.tool, w.cell.tracker
    steps = (("calibrate", "{first}", "--also", "{second}"),)
    sessions = {"first": w.clean(90), "second": spare.clean(90, begin=90 * PERIOD + 900.0)}
    return Case(sessions, steps, True, (r"\brecordings?\b", r"\border\b", r"\btime\b", r"stations \d", *EITHER))


@again
def unit_changed_between_days(w: Works, rng: np.random.Generator) -> Case:
    """The tracker's software wrote metres when the arm was calibrated and writes millimetres today."""
    second = w.clean(80, begin=86_400.0)
    return frozen(w.clean(120), replace(second, p=1e3 * second.p), UNIT)


@again
def the_other_part_found_again(w: Works, rng: np.random.Generator) -> Case:
    """The tracker was moved, and the command line asks for the tool to be found again."""
    second = w.clean(80, w.base(w.way(0.02), w.way(0.01), from_(0)), begin=3600.0)
    return frozen(w.clean(120), second, BASE, "--refit-tool")

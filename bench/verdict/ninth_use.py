"""The ninth group, continued: effects on top of real readings, what is stated, frozen calibrations, sockets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import yaml
from case import Case
from ninth import ANY, BASE, COMPUTED, POINTS, POSES, TOOL, UNIT, Array, after, any_of, named, ninth, way
from ninth_data import DATA, ROOT, Table, calibration, evaluation, recording
from workcell import Works

JOINTED = ("cubes", "grid", "ur5")


def _planted(
    rng: np.random.Generator, words: tuple[str, ...], error: Callable[[Table, int], Array], *options: str, low: int = 1
) -> Case:
    """One joint reports other than it stands by an error (N,) [rad], in what is kept aside as well."""
    table, aside = any_of(rng, *JOINTED)
    j = int(rng.integers(low, 5))
    table, aside = (each.joint(j, error(each, j)) for each in (table, aside))
    return calibration(table, (*named(table, j), *words), aside, *options)


@ninth
def ninth_gear_wave(w: Works, rng: np.random.Generator) -> Case:
    """A worn gear: 1.2 mrad, some times a turn."""
    k, phase = int(rng.integers(3, 12)), rng.uniform(0, 6.28)
    return _planted(rng, (), lambda table, j: 1.2e-3 * np.sin(k * table.q[:, j] + phase))


@ninth
def ninth_backlash(w: Works, rng: np.random.Generator) -> Case:
    """Backlash of 2 mrad by the side from which a joint comes."""

    def error(table: Table, j: int) -> Array:
        came = np.diff(table.q[:, j], prepend=table.q[:1, j])
        side = np.zeros(len(came))
        for i in range(1, len(came)):
            side[i] = np.sign(came[i]) if abs(came[i]) > 1e-4 else side[i - 1]
        return 1e-3 * side

    return _planted(rng, (), error)


@ninth
def ninth_soft_joint(w: Works, rng: np.random.Generator) -> Case:
    """The shoulder sags by 3 mrad where the arm is stretched out."""
    table, aside = any_of(rng, *JOINTED)
    reach = max(float(np.abs(t.p - table.p.mean(axis=0)).max()) for t in (table, aside))

    def sagged(t: Table) -> Table:
        lever = np.cos(t.q[:, 1]) * 0.6 + np.cos(t.q[:, 1] + t.q[:, 2]) * 0.5
        return t.joint(1, 3e-3 * lever / max(reach, 1.0))

    words = (*named(table, 1), "compliance", "load")
    return calibration(sagged(table), words, sagged(aside))


@ninth
def ninth_joint_warms_up(w: Works, rng: np.random.Generator) -> Case:
    """A joint drifts by 2 mrad with a time constant of a third of the recording; kept aside is the warm arm."""
    table, aside = any_of(rng, *JOINTED)
    j = int(rng.integers(1, 5))
    n = len(table)
    drift = 2e-3 * (1.0 - np.exp(-3.0 * np.arange(n) / n))
    words = (*named(table, j), "drift", "warm", "time", "order")
    return calibration(table.joint(j, drift), words, after(table, aside).joint(j, float(drift[-1])))


@ninth
def ninth_loose_encoder(w: Works, rng: np.random.Generator) -> Case:
    """A joint scatters by 1.5 mrad: its encoder's coupling is loose."""
    return _planted(rng, ("scatter",), lambda table, j: rng.normal(0.0, 1.5e-3, len(table)))


@ninth
def ninth_slips_once(w: Works, rng: np.random.Generator) -> Case:
    """A belt jumps a tooth, of 10 mrad, after two thirds; kept aside is the arm as it is since."""
    table, aside = any_of(rng, *ANY)
    j = int(rng.integers(1, 5))
    rows = np.arange(len(table)) >= 2 * len(table) // 3
    return calibration(table.joint(j, 1e-2 * rows), named(table, j), after(table, aside).joint(j, 1e-2))


@ninth
def ninth_geometry_only(w: Works, rng: np.random.Generator) -> Case:
    """A worn gear, and --geometry-only."""
    k = int(rng.integers(3, 12))
    words = ("geometry-only", "geometry only", "not looked for")
    return _planted(rng, words, lambda table, j: 1.2e-3 * np.sin(k * table.q[:, j]), "--geometry-only")


def _stated(arm_mm: float, eye_mm: float) -> tuple[str, ...]:
    return ("--repeatability-mm", f"{arm_mm:.4f}", "--instrument-mm", f"{eye_mm:.4f}")


@ninth
def ninth_stated_ten_times_too_good(w: Works, rng: np.random.Generator) -> Case:
    """The data sheet's repeatability and the tracker's, a tenth of what they are."""
    table, aside = recording("ur5")
    return calibration(table, (), aside, *_stated(0.004, 0.003))


@ninth
def ninth_stated_ten_times_too_bad(w: Works, rng: np.random.Generator) -> Case:
    """A repeatability stated for another arm, ten times as large, and a joint whose gear is worn."""
    k = int(rng.integers(3, 9))
    table, aside = recording("ur5")
    j = int(rng.integers(1, 4))
    bent, kept = (t.joint(j, 1.5e-3 * np.sin(k * t.q[:, j])) for t in (table, aside))
    return calibration(bent, (*named(table, j), "stated"), kept, *_stated(0.4, 0.3))


@ninth
def ninth_described_by_its_calibration(w: Works, rng: np.random.Generator) -> Case:
    """The nominal arm is the one that an earlier calibration on the same rows wrote: nothing is left to gain."""
    table, aside = any_of(rng, *JOINTED)
    case = calibration(table, (), aside, shown="if missed")
    first = ("calibrate", "{bag}", "--out", "{before}")
    *imports, last = case.steps
    return replace(case, steps=(*imports, first, (*last, "--urdf", "{before/calibrated.urdf}")))


@ninth
def ninth_frozen_joint_remastered(w: Works, rng: np.random.Generator) -> Case:
    """Since the calibration one joint was mastered anew, 4 mrad away."""
    table, aside = any_of(rng, *JOINTED)
    j = int(rng.integers(1, 5))
    return evaluation(table, aside.joint(j, 4e-3), (*named(table, j), *TOOL, *BASE))


@ninth
def ninth_frozen_tracker_moved(w: Works, rng: np.random.Generator) -> Case:
    """Since the calibration the tracker was set up again; nobody said --refit-base."""
    table, aside = any_of(rng, *ANY)
    rows = np.ones(len(aside), bool)
    return evaluation(table, aside.base(rows, way(rng, 0.1), way(rng, 0.05)), (*BASE, "refit-base", "tracker"))


@ninth
def ninth_frozen_other_target(w: Works, rng: np.random.Generator) -> Case:
    """Since the calibration the target was exchanged; only the base is fitted again."""
    table, aside = any_of(rng, *POSES)
    moved = aside.tool(np.ones(len(aside), bool), way(rng, 4e-3), way(rng, 0.01))
    return evaluation(table, moved, TOOL, "--refit-base")


@ninth
def ninth_frozen_other_arm(w: Works, rng: np.random.Generator) -> Case:
    """The calibration of the UR10 on the readings of a UR5: the joints have the same names."""
    table, _ = recording("cubes")
    _, other = recording("ur5")
    words = ("another arm", "another robot", "URDF", "arm", "lengths", "rejected", "description", *UNIT)
    return evaluation(table, replace(other, robot=table.robot), words)


@ninth
def ninth_frozen_another_payload(w: Works, rng: np.random.Generator) -> Case:
    """Since the calibration a payload hangs on the arm: shoulder and elbow sag by 2 mrad and 1 mrad."""
    table, aside = any_of(rng, *JOINTED)

    def laden(t: Table) -> Table:
        upper, fore = np.cos(t.q[:, 1]), np.cos(t.q[:, 1] + t.q[:, 2])
        return t.joint(1, 2e-3 * (upper + fore) / 2.0).joint(2, 1e-3 * fore)

    words = (*named(table, 1, 2), "payload", "load", "weight")
    return evaluation(table, laden(aside), words, "--refit-base", "--refit-tool")


@ninth
def ninth_frozen_in_metres(w: Works, rng: np.random.Generator) -> Case:
    """The second table is in metres, and the mapping of the first was used again."""
    table, aside = any_of(rng, *ANY)
    return evaluation(table, replace(aside, p=1e-3 * aside.p), UNIT)


@ninth
def ninth_frozen_on_its_own_rows(w: Works, rng: np.random.Generator) -> Case:
    """Half of the rows that are judged are those of the calibration."""
    table, _ = any_of(rng, *ANY)
    rows = np.sort(rng.choice(len(table), len(table) // 2, replace=False))
    words = ("own recording", "same recording", "fitted to", "already", "its own")
    return evaluation(table, table.only(rows), words)


@ninth
def ninth_frozen_two_joints_exchanged(w: Works, rng: np.random.Generator) -> Case:
    """The second logger writes two joints in another order."""
    table, aside = any_of(rng, *ANY)
    j = int(rng.integers(0, 5))
    q = aside.q.copy()
    q[:, [j, j + 1]] = q[:, [j + 1, j]]
    return evaluation(table, replace(aside, q=q), ("swapped", "exchanged", "order", "mixed", *named(table, j)))


@ninth
def ninth_frozen_controller(w: Works, rng: np.random.Generator) -> Case:
    """The readings that are judged are what the controller meant."""
    table, aside = any_of(rng, *POINTS)
    assert aside.goal is not None
    return evaluation(table, replace(aside, p=np.round(aside.goal, 5)), COMPUTED, "--refit-base")


def _sockets(arm: str) -> tuple[dict[str, Array], list[str], dict]:
    """Joints (N, 7) [rad] by the name of the socket, names of joints, and the cell file."""
    rows = {
        f"{path.parent.name}_{path.stem}": np.loadtxt(path, delimiter=",")
        for path in sorted((DATA / "mukca" / arm).glob("*/hole_?.csv"))
    }
    here = ROOT / "examples" / "import"
    table = yaml.safe_load((here / f"mukca_{arm}.yaml").read_text(encoding="utf-8"))["tables"][0]
    cell = yaml.safe_load((here / f"mukca_{arm}_cell.yaml").read_text(encoding="utf-8"))
    return rows, list(table["joints"]["columns"]), cell


def _in_sockets(
    arm: str, rows: dict[str, Array], names: list[str], cell: dict, words: tuple[str, ...], **truth: object
) -> Case:
    urdf = "iiwa14" if arm.startswith("kuka") else "panda"
    text = (DATA / "mukca" / "urdf" / f"{urdf}.urdf").read_text(encoding="utf-8")
    mapping = {
        "tables": [
            {
                "files": f"{socket}.csv",
                "header": False,
                "time": {"order": {"period_s": 10.0}},
                "joints": {"unit": "rad", "columns": {name: j for j, name in enumerate(names)}},
                "same_point": {"frame": socket},
            }
            for socket in rows
        ]
    }
    files = {f"{s}.csv": "\n".join(",".join(f"{v:.9g}" for v in row) for row in q) + "\n" for s, q in rows.items()}
    files |= {"arm.urdf": text, "bag.yaml": yaml.safe_dump(mapping), "cell.yaml": yaml.safe_dump(cell)}
    steps = (
        ("import", "{bag.yaml}", "--urdf", "{arm.urdf}", "--out", "{bag}"),
        ("calibrate", "{bag}", "--tip", "ball_link", "--cell", "{cell.yaml}", "--tolerance-mm", "0.8"),
    )
    return Case({}, steps, True, words, False, files=files, floor_mm=0.25, **truth)  # type: ignore[arg-type]


def _any_arm(rng: np.random.Generator) -> str:
    return str(rng.choice(["panda_3", "panda_4", "kuka_14"]))


@ninth
def ninth_sockets_mixed_up(w: Works, rng: np.random.Generator) -> Case:
    """The last third of one socket's rows belongs to its neighbour on the plate."""
    arm = _any_arm(rng)
    rows, names, cell = _sockets(arm)
    one = str(rng.choice([s for s in rows if s.endswith("_0")]))
    k = 2 * len(rows[one]) // 3
    other = one[:-1] + "1"
    rows[other] = np.concatenate([rows[other], rows[one][k:]])
    rows[one] = rows[one][:k]
    return _in_sockets(arm, rows, names, cell, (one, other, "socket", "rejected"))


@ninth
def ninth_plate_moved(w: Works, rng: np.random.Generator) -> Case:
    """Rows of two placements of the plate under one name."""
    arm = _any_arm(rng)
    rows, names, cell = _sockets(arm)
    one, two = rng.choice([s[:-2] for s in rows if s.endswith("_0")], 2, replace=False)
    for hole in "01":
        rows[f"{one}_{hole}"] = np.concatenate([rows[f"{one}_{hole}"], rows.pop(f"{two}_{hole}")])
    cell = cell | {"distances": [d for d in cell["distances"] if not d["between"][0].startswith(two)]}
    return _in_sockets(arm, rows, names, cell, (one, "socket", "rejected", "placement", "plate"))


@ninth
def ninth_sockets_joint_reversed(w: Works, rng: np.random.Generator) -> Case:
    """A joint counts the other way."""
    arm = _any_arm(rng)
    rows, names, cell = _sockets(arm)
    j = int(rng.integers(1, 6))
    rows = {s: q * np.where(np.arange(7) == j, -1.0, 1.0) for s, q in rows.items()}
    return _in_sockets(arm, rows, names, cell, (names[j],))


@ninth
def ninth_sockets_a_joint_remastered(w: Works, rng: np.random.Generator) -> Case:
    """Between the first placements and the last a joint was mastered anew, 5 mrad away."""
    arm = _any_arm(rng)
    rows, names, cell = _sockets(arm)
    j = int(rng.integers(1, 6))
    late = list(rows)[len(rows) // 2 :]
    rows = {s: q + 5e-3 * (np.arange(7) == j) * (s in late) for s, q in rows.items()}
    return _in_sockets(arm, rows, names, cell, (names[j], "distance", "apart"))


@ninth
def ninth_sockets_wider(w: Works, rng: np.random.Generator) -> Case:
    """The sockets' distance was taken from the outside edges: 1.5 mm too much."""
    arm = _any_arm(rng)
    rows, names, cell = _sockets(arm)
    cell = {"distances": [d | {"distance_m": 0.0515} for d in cell["distances"]]}
    return _in_sockets(arm, rows, names, cell, ("distance", "apart"))


@ninth
def ninth_sockets_read_at_rest(w: Works, rng: np.random.Generator) -> Case:
    """The program noted each posture five times."""
    arm = _any_arm(rng)
    rows, names, cell = _sockets(arm)
    rows = {s: np.repeat(q[::5], 5, axis=0) for s, q in rows.items()}
    return _in_sockets(arm, rows, names, cell, (), shown=False)

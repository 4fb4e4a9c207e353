"""A folder of images with a table of joints: what is read, what is left out and why, and whose joints are whose."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from modcal_core.camera import (
    FISHEYE,
    NOTHING_KNOWN,
    PINHOLE,
    STATED,
    BoardView,
    ImageMoments,
    Lens,
    MarkerBundle,
    PrintedTarget,
)
from modcal_core.errors import BadRecording, BadTable, NotEnoughData
from modcal_core.files import parse_yaml
from modcal_core.geometry import Array
from modcal_nodes.vision.detection import Detection, detect

SCALED = "Images of 16 bits a channel were scaled to 8, each from its own black to its own white."
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
_MAX_BYTES = 1 << 28  # of one image, before it is read
_MAX_IMAGES = 5000
_MAX_OF_INFO = 1 << 20  # characters of a camera_info file
_MAX_TABLE = 1 << 28  # bytes of a table of joints
_MOSAIC = 0.04  # relative difference between the four phases of a Bayer pattern; those of a grey image differ by noise
_DEGREES = 4.0 * np.pi  # rad; no joint turns farther, and degrees do
_UNITS = {"deg": np.pi / 180.0, "°": np.pi / 180.0, "rad": 1.0, "m": 1.0, "mm": 1e-3}
_WITH_UNIT = re.compile(r"(.+?)\s*[\[(](deg|°|rad|mm|m)[\])]", re.IGNORECASE)
_NANOSECONDS = 1e14  # stamps beyond it are nanoseconds
_GAP_S = 0.2  # between joint states around an image, beyond which they do not say where the arm was
# Of the pixels of an image of more than 8 bits, black and white of which are spread over 8: pixels that are stuck or
# blinded are fewer, and no target fills less of an image that shows it.
_DARK, _BRIGHT = 0.1, 99.9


@dataclass(frozen=True)
class ImageFolder:
    """views: of the target, in the order of the images' names. q, velocity: of the joints at each, (N, n). size: of the
    images [px]. left_out: images by reason, each with its remedy. lens, lens_of: what was recorded with them says of
    the lens, None where nothing does, and where. moments: what effects may depend on. notes: what was done to images,
    in sentences.
    """

    views: tuple[BoardView, ...]
    q: Array
    velocity: Array
    size: tuple[int, int]
    left_out: dict[str, str]
    lens: Lens | None = None
    lens_of: str = ""
    moments: ImageMoments = NOTHING_KNOWN
    notes: tuple[str, ...] = ()


def read_images(
    folder: Path,
    joints: Path,
    names: Sequence[str],
    target: PrintedTarget | MarkerBundle,
    progress: Callable[[str, float | None], None] = lambda stage, share: None,
) -> ImageFolder:
    """The target in every image of a folder, and where the arm's joints were.

    joints: CSV, its first line the columns: ``image`` and one a joint [rad, m], or ``stamp`` [s] and one a joint, where
    the images are named by their stamps. names: of the robot's joints. Raises ModcalError where nothing can be used.
    """
    files = sorted((f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES), key=_order)
    if not files:
        raise BadRecording(str(folder), "holds no image", f"give a folder with {', '.join(SUFFIXES[:3])} files")
    if len(files) > _MAX_IMAGES:
        raise BadRecording(str(folder), f"holds {len(files)} images, {_MAX_IMAGES} are read", "give fewer")
    rows = joints_of(read_csv(joints), names, str(joints))
    found, at = FoundTargets(), list[tuple[Array, Array]]()
    for i, file in enumerate(files):
        progress("finding the target", i / len(files))
        if (place := rows.at(file)) is None:
            found.left_out[file.name] = "the table has no joints for it: give it a row"
            continue
        if file.stat().st_size > _MAX_BYTES:
            found.left_out[file.name] = f"has more than {_MAX_BYTES >> 20} MiB: give a smaller image"
            continue
        packed = np.frombuffer(file.read_bytes(), np.uint8)
        grey, why = unpacked_grey(packed, "cannot be read as an image: save it again", "convert it to 8 bits")
        if grey is None:
            found.left_out[file.name] = why
        elif found.take(detect(grey, target, file.name), file.name, (grey.shape[1], grey.shape[0]), why):
            at.append(place)
    size, same = found.of_one_size(str(folder), len(files))
    q, velocity = (np.stack(part)[same] for part in zip(*at, strict=True))
    return ImageFolder(tuple(found.views), q, velocity, size, found.left_out, notes=tuple(found.notes))


@dataclass
class FoundTargets:
    """What images show of a target. views: of it, sizes: of their images [px]. left_out, notes: as of a folder."""

    views: list[BoardView] = field(default_factory=list)
    sizes: list[tuple[int, int]] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    notes: dict[str, None] = field(default_factory=dict)

    def take(self, found: Detection, name: str, size: tuple[int, int], note: str = "") -> bool:
        """Whether this image shows the target; else it is left out. note: what was done to it."""
        if found.view is None:
            self.left_out[name] = f"{found.reason}: {found.remedy}"
            return False
        self.notes |= dict.fromkeys([note] if note else ())
        self.views.append(found.view)
        self.sizes.append(size)
        return True

    def of_one_size(self, source: str, count: int) -> tuple[tuple[int, int], np.ndarray]:
        """(the size that most views have, which of them had it (N,)); the others are left out.

        count: of the images that were looked at. Raises NotEnoughData where none shows the target.
        """
        if not self.views:
            name, why = next(iter(self.left_out.items()))
            reason, _, remedy = why.partition(": ")
            raise NotEnoughData(source, f"none of {count} images can be used; {name} {reason}", remedy)
        size = Counter(self.sizes).most_common(1)[0][0]
        same = np.array([own == size for own in self.sizes])
        for view, own in zip(self.views, self.sizes, strict=True):
            if own != size:
                said = f"is {own[0]} × {own[1]}, most are {size[0]} × {size[1]}: give images of one size"
                self.left_out[view.name] = said
        self.views = [view for view, keep in zip(self.views, same, strict=True) if keep]
        return size, same


def read_camera_info(path: Path) -> Lens:
    """The lens in a YAML file as ROS's camera calibrators write it, or OpenCV. Raises BadTable."""
    try:
        text = path.read_bytes()[: _MAX_OF_INFO + 1].decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadTable(str(path), "is not UTF-8 text", "give a YAML file") from error
    if len(text) > _MAX_OF_INFO:
        raise BadTable(str(path), "is larger than a camera_info file", "give one camera's intrinsics")
    # OpenCV writes its matrices with a tag of its own, and older versions a first line that is no YAML
    text = re.sub(r"\A%YAML:.*$", "", text, flags=re.MULTILINE).replace("!!opencv-matrix", "")
    return lens_from_data(parse_yaml(text, str(path)), str(path))


def lens_from_data(data: Any, source: str) -> Lens:
    """The lens that a camera_info file, or Kalibr's camchain, describes. Raises BadTable, naming the source."""
    try:
        K, d, size, model = _of_kalibr(data, source) if "camera_matrix" not in data else _of_info(data)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        remedy = "give image_width, image_height, camera_matrix and distortion_coefficients as camera_info files do"
        raise BadTable(source, "is not a camera_info file", remedy) from error
    usable = bool(np.isfinite(K).all() and np.isfinite(d).all() and K[0, 0] > 0.0 and K[1, 1] > 0.0)
    count, d = len(d), np.trim_zeros(d, "b")
    known = _MODELS.get(model)
    if known is None or len(d) > STATED[known] or not usable:
        said = f"has model {model[:40]} with {count} coefficients"
        remedy = "give plumb_bob or rational_polynomial with up to eight coefficients, or equidistant with four"
        if known == PINHOLE and usable:
            remedy += "; leave it to the images where it has more, for thin prisms or tilt: rectified ones have none"
        raise BadTable(source, said, remedy)
    return Lens.of(K, d, size, known)


_MODELS = {"plumb_bob": PINHOLE, "": PINHOLE, "radtan": PINHOLE, "rational_polynomial": PINHOLE}
_MODELS |= {"equidistant": FISHEYE, "fisheye": FISHEYE}
_Intrinsics = tuple[np.ndarray, np.ndarray, tuple[int, int], str]


def _of_info(data: Any) -> _Intrinsics:
    K = np.array(data["camera_matrix"]["data"], dtype=float).reshape(3, 3)
    d = np.array(data.get("distortion_coefficients", {"data": []})["data"], dtype=float).ravel()
    size = int(data["image_width"]), int(data["image_height"])
    return K, d, size, str(data.get("distortion_model", "plumb_bob"))


def _of_kalibr(data: Any, source: str) -> _Intrinsics:
    cameras = [key for key in data if re.fullmatch(r"cam\d+", str(key))]
    if len(cameras) > 1:
        raise BadTable(source, f"has {len(cameras)} cameras ({', '.join(cameras)})", "give the file of one of them")
    camera = data[cameras[0]] if cameras else data["cam0"]
    fx, fy, cx, cy = map(float, camera["intrinsics"])
    width, height = map(int, camera["resolution"])
    model = camera["distortion_model"] if camera["camera_model"] == "pinhole" else camera["camera_model"]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return K, np.array(camera["distortion_coeffs"], dtype=float).ravel(), (width, height), str(model)


def require_size(lens: Lens, size: tuple[int, int], source: str) -> None:
    """Raises BadTable unless a lens is of images of this size."""
    if lens.size != size:
        said = f"is of images of {lens.size[0]} × {lens.size[1]}, these are {size[0]} × {size[1]}"
        raise BadTable(source, said, "give the camera_info of this resolution")


def _order(file: Path) -> tuple[float, str]:
    """Numbered files by their number, others by name."""
    digits = "".join(c for c in file.stem if c.isdigit())
    return (float(digits) if digits and len(digits) < 300 else 0.0, file.name)


def unpacked_grey(packed: np.ndarray, damaged: str, remedy: str) -> tuple[np.ndarray | None, str]:
    """(grey image of 8 bits, what was done to it, or nothing) or (None, why not and what to do) of a packed image.

    damaged: said of one that is none. remedy: for one whose numbers are not read.
    """
    try:
        image = cv2.imdecode(packed, cv2.IMREAD_UNCHANGED)
    except cv2.error:  # empty, or of more pixels than OpenCV reads
        image = None
    if image is None:
        return None, damaged
    if image.dtype not in (np.uint8, np.uint16):
        return None, f"has {8 * image.dtype.itemsize} bits a channel: {remedy}"
    if image.ndim == 3:
        code = cv2.COLOR_BGRA2GRAY if image.shape[2] == 4 else cv2.COLOR_BGR2GRAY
        image = np.asarray(cv2.cvtColor(image, code)) if image.shape[2] >= 3 else image[:, :, 0]
    elif is_mosaic(image):
        return None, "is a raw Bayer mosaic: convert it to grey or colour (debayer) first"
    return in_eight_bits(image)


def in_eight_bits(grey: np.ndarray) -> tuple[np.ndarray, str]:
    """(grey image (h, w) of 8 bits, what was done to it): one of 16 bits, of which cameras fill 10, 12 or all, is
    spread from its own black to its own white.
    """
    if grey.dtype == np.uint8:
        return grey, ""
    dark, bright = np.percentile(grey, [_DARK, _BRIGHT])
    spread = (grey - dark) * (255.0 / max(float(bright - dark), 1.0))
    return np.clip(np.rint(spread), 0.0, 255.0).astype(np.uint8), SCALED


def is_mosaic(grey: np.ndarray) -> bool:
    """Whether the four phases of pixels (h, w) differ, as they do behind a colour filter."""
    h, w = (s - s % 2 for s in grey.shape)
    if not h or not w:
        return False
    usual = np.minimum(grey[:h, :w], np.percentile(grey, _BRIGHT))  # a stuck pixel is no colour
    phases = usual.reshape(h // 2, 2, w // 2, 2).mean(axis=(0, 2))
    return bool(np.ptp(phases) > _MOSAIC * max(float(phases.mean()), 1.0))


@dataclass(frozen=True)
class JointTable:
    """Rows of a table by image, or a log by stamp."""

    source: str
    by_name: dict[str, Array]
    stamps: Array
    q: Array

    def at(self, file: Path) -> tuple[Array, Array] | None:
        """(positions, velocities) at an image, None where the table says nothing of it."""
        if self.by_name:
            q = self.by_name.get(file.name, self.by_name.get(file.stem))
            return None if q is None else (q, np.zeros_like(q))
        stamp = _stamp(file.stem)
        if stamp is None:
            return None
        i = int(np.searchsorted(self.stamps, stamp))
        if i == 0 or i == len(self.stamps) or self.stamps[i] - self.stamps[i - 1] > _GAP_S:
            return None
        span = self.stamps[i] - self.stamps[i - 1]
        rate = (self.q[i] - self.q[i - 1]) / span
        return self.q[i - 1] + (stamp - self.stamps[i - 1]) * rate, rate


def _stamp(text: str) -> float | None:
    try:
        stamp = float(text)
    except ValueError:
        return None
    return (1e-9 * stamp if stamp > _NANOSECONDS else stamp) if np.isfinite(stamp) else None


def read_csv(path: Path) -> list[list[str]]:
    """The cells of a table. Raises BadTable for one that is too large or is none."""
    if path.stat().st_size > _MAX_TABLE:
        raise BadTable(str(path), f"has more than {_MAX_TABLE >> 20} MiB", "give a table of joints")
    try:
        return csv_cells(path.read_text(encoding="utf-8-sig"), str(path))
    except UnicodeDecodeError as error:
        raise BadTable(str(path), "is not UTF-8 text", "give a CSV file") from error


def csv_cells(text: str, source: str) -> list[list[str]]:
    """The cells of a CSV with commas or semicolons, rows without any left out. Raises BadTable, naming the source."""
    first = text.partition("\n")[0]
    delimiter = ";" if first.count(";") > first.count(",") else ","
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines(), delimiter=delimiter)]
    except csv.Error as error:
        raise BadTable(source, f"is not CSV ({error})", "give columns with commas between") from error
    return [row for row in rows if any(row)]


def joint_column(cell: str) -> tuple[str, float]:
    """(name, what its numbers are multiplied with to be radians or metres) of a column: ``elbow``, ``elbow [deg]``."""
    found = _WITH_UNIT.fullmatch(cell)
    return (found[1].strip(), _UNITS[found[2].lower()]) if found else (cell, 1.0)


def joints_of(
    table: list[list[str]], names: Sequence[str], source: str, repeated: bool = False, by_row: bool = False
) -> JointTable:
    """The joints in the cells of a table, checked. repeated: an image may have several rows of the same joints, as in a
    table of corners. by_row: rows are of the images by their number, from 1, where no column says of which. Raises
    BadTable, naming the source.
    """
    if len(table) < 2:
        raise BadTable(source, "holds no row of joints", "give a line of column names, then one row an image")
    header, scales = zip(*(joint_column(cell) for cell in table[0]), strict=True)
    missing = [name for name in names if name not in header]
    if missing:
        said = f"has no column for joint {missing[0]} (it has {', '.join(header)[:120]})"
        raise BadTable(source, said, "name the columns as the URDF names its joints")
    key = next((k for k in ("image", "stamp") if k in header), None)
    if key is None and not by_row:
        raise BadTable(source, "has neither a column image nor a column stamp", "say which image a row belongs to")
    columns = [header.index(name) for name in names]
    keys, values = [], []
    for number, row in enumerate(table[1:], start=2):
        try:
            values.append([float(row[c]) for c in columns])
            keys.append(str(number - 1) if key is None else row[header.index(key)])
        except (ValueError, IndexError) as error:
            raise BadTable(f"{source}: line {number}", "holds a value that cannot be read", "give numbers") from error
    q = np.array(values) * [scales[c] for c in columns]
    if not np.isfinite(q).all():
        line = int(np.argmax(~np.isfinite(q).all(axis=1))) + 2
        raise BadTable(f"{source}: line {line}", "holds a number that is not finite", "correct it")
    if np.abs(q).max() > _DEGREES:
        said = f"holds {np.abs(q).max():.0f}, and no joint turns so far in radians"
        raise BadTable(source, said, f"give radians and metres, or name the columns {names[0]} [deg] and so on")
    if key != "stamp":
        by_name: dict[str, Array] = {}
        for name, row_q in zip((Path(k).name for k in keys), q, strict=True):
            if name in by_name and not (repeated and np.array_equal(by_name[name], row_q)):
                said = f"has two rows for image {name[:80]}" + (" that differ" if repeated else "")
                raise BadTable(source, said, "give one row an image")
            by_name[name] = row_q
        return JointTable(source, by_name, np.empty(0), q)
    stamps = np.array([_stamp(k) if _stamp(k) is not None else np.nan for k in keys], dtype=float)
    if not (np.diff(stamps) > 0.0).all():
        raise BadTable(source, "has stamps that do not increase", "give rows in the order of time, in seconds")
    return JointTable(source, {}, stamps, q)

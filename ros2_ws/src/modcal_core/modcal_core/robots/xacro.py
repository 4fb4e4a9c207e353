"""A robot's joint origins as a file that xacro includes, for descriptions that are written in xacro."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from modcal_core.errors import NotRepresentable
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

_NAME = "calibrated"
# what may stand in a Python text in single quotes, in XML, inside xacro's ${…}
_WRITABLE = re.compile(r"[\w.:/ -]+")


def xacro_origins(origins: Mapping[str, Array], notes: Sequence[str] = ()) -> str:
    """The text of a xacro file with one property, ``calibrated``, that holds xyz [m] and rpy [rad] by joint name.

    origins: ``T_parent_joint`` (4, 4). A description that includes the file writes
    ``<origin xyz="${calibrated['JOINT']['xyz']}" rpy="${calibrated['JOINT']['rpy']}"/>``; numbers keep every digit.
    notes become comments. Raises NotRepresentable for a joint whose name cannot stand in a xacro expression.

    xacro ends an expression at its first closing brace, so the mapping is written by calls of ``dict``.
    """
    odd = next((name for name in origins if not _WRITABLE.fullmatch(name)), None)
    if odd is not None:
        raise NotRepresentable(f"joint '{odd}'", "has a name that no xacro expression holds", "use the URDF itself")
    rows = [
        f"      ('{name}', dict(xyz='{_numbers(T[:3, 3])}', rpy='{_numbers(so3.to_rpy(T[:3, :3]))}'))"
        for name, T in origins.items()
    ]
    listed = ",\n".join(rows)
    comments = "".join(f"  <!-- {note.replace('--', '—')} -->\n" for note in notes)
    return (
        '<?xml version="1.0"?>\n'
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro">\n'
        f"{comments}"
        f'  <xacro:property name="{_NAME}" value="${{dict([\n{listed}\n    ])}}"/>\n'
        "</robot>\n"
    )


def _numbers(values: Array) -> str:
    return " ".join(repr(float(v) + 0.0) for v in values)

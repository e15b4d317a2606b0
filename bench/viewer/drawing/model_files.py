"""The robot as URDF for simulators, at address as glTF for people and STEP for a workshop, and its masses.

STEP: exact solids, one labelled assembly a body, millimetres, Z up, X along the target line, as in the URDF.
It needs build123d (extra `cad`).

glTF: one binary file (.glb); one node a body, with its pose; below it one mesh with a primitive for each
colour. Metres, Y up, X along the target line: the golf frame is glTF's own.

URDF has inertias of the dynamics, drawn meshes, outlines of the clearance checks. It is a tree, the robot has
a loop: the right arm's cylinder hangs from its rod, and the two links `right_shoulder` (on the shoulder link)
and `right_shoulder_of_cylinder` are to coincide. A simulator closes the loop with a point constraint between
them; `closure.json` in the same folder defines it.

Root: `ground`, Z up, X along the target line, the origin below the point of impact. Joint values are those of
the bench: shoulder, arm, wrist; rod and cylinder follow from them.

The outlines that can collide are those of the clearance checks. `bench/control/envelope.py` and
`bench/design/static_checks.py` take the club as the line from the wrist to the centre of the face with a sole
at `plant.site.sole_depth` below it. The frame is a disc of `envelope.min_frame_distance` round R1, and the
ground a line. Here the same settings become solids; the checks' numbers stay their own.
"""

from __future__ import annotations

import csv
import io
import json
import struct
from collections.abc import Sequence
from math import pi
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent

import numpy as np
from scipy.spatial.transform import Rotation

from bench.base.atomic_file import atomic_file, atomic_path, write_whole
from bench.base.errors import load_extra
from bench.viewer.drawing.bodies import (
    NO_TURN,
    Bar,
    Colour,
    DrawnBody,
    Ellipsoid,
    Part,
    PlacedBody,
    Solid,
    Tube,
    joined_meshes,
    write_stl,
)
from bench.viewer.drawing.drawing import draw, plane_to_golf
from sim.plant import PlantParameters
from sim.pneumatics import Actuator
from sim.robot import Body, Club

_FLOAT, _UNSIGNED = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_GLTF, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942


def by_colour(body: DrawnBody) -> dict[Colour, list[Part]]:
    """Return the parts of a body by colour."""
    return {
        colour: [part for part in body.parts if part.material.colour == colour]
        for colour in dict.fromkeys(part.material.colour for part in body.parts)
    }


def _material(colour: Colour) -> dict[str, Any]:
    """Return a dull material; glTF counts colours linearly."""
    linear = [((value / 255 + 0.055) / 1.055) ** 2.4 for value in colour]
    surface = {"baseColorFactor": [*linear, 1.0], "metallicFactor": 0.1, "roughnessFactor": 0.6}
    return {"pbrMetallicRoughness": surface}


def gltf(bodies: Sequence[PlacedBody]) -> bytes:
    """Return the bodies as a binary glTF file."""
    colours = list(dict.fromkeys(colour for one in bodies for colour in by_colour(one.body)))
    data = bytearray()
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []

    def added(values: np.ndarray, kind: str, component: int, target: int) -> int:
        """Append `values` to the binary chunk; return the accessor's index."""
        raw = values.tobytes()
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(raw), "target": target})
        data.extend(raw)
        accessor = {"bufferView": len(accessors), "componentType": component, "type": kind}
        accessor |= {"count": len(values)}
        if kind == "VEC3":
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        accessors.append(accessor)
        return len(accessors) - 1

    def primitive(colour: Colour, parts: list[Part]) -> dict[str, Any]:
        mesh = joined_meshes([part.solid.mesh for part in parts])
        position, normal = (
            added(values.astype("<f4"), "VEC3", _FLOAT, _VERTICES) for values in (mesh.vertices, mesh.normals)
        )
        indices = added(mesh.triangles.astype("<u4").ravel(), "SCALAR", _UNSIGNED, _INDICES)
        attributes = {"POSITION": position, "NORMAL": normal}
        return {"attributes": attributes, "indices": indices, "material": colours.index(colour)}

    content = {
        "asset": {"version": "2.0", "generator": "golfbench"},
        "scene": 0,
        "scenes": [{"name": "golfbench", "nodes": list(range(len(bodies)))}],
        "nodes": [
            {
                "name": one.body.name,
                "mesh": number,
                "translation": [float(value) for value in one.at],
                "rotation": Rotation.from_matrix(one.turn).as_quat().tolist(),
            }
            for number, one in enumerate(bodies)
        ],
        "meshes": [
            {"name": one.body.name, "primitives": [primitive(*part) for part in by_colour(one.body).items()]}
            for one in bodies
        ],
        "materials": [_material(colour) for colour in colours],
        "accessors": accessors,
        "bufferViews": views,
    }
    text = json.dumps(content | {"buffers": [{"byteLength": len(data)}]}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), _JSON) + text
    chunks += struct.pack("<II", len(data), _BINARY) + bytes(data)
    return struct.pack("<III", _GLTF, 2, 12 + len(chunks)) + chunks


_FRAME_LENGTH = 0.10
"""Length of the frame's cylinder round R1, across the swing plane (m)."""
MESHES = "meshes"
"""Folder of the meshes, next to the URDF."""
CLOSURE = ("right_shoulder", "right_shoulder_of_cylinder")
"""Links that the loop holds together."""
EFFORT, SPEED = 2000.0, 100.0
"""Limits that URDF demands: N m or N, rad/s or m/s; above all that the actuators can do."""
_SLACK = 0.35
"""Room beyond the working range (rad), for cushions and simulators that dislike a limit."""
Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation from the golf frame to that of URDF and STEP."""


class Hinge(NamedTuple):
    """A joint of the tree: kind, parent, child, its origin along the parent's x (m) and its limits."""

    name: str
    kind: str
    parent: str
    child: str
    x: float
    lower: float
    upper: float


def joints(plant: PlantParameters) -> list[Hinge]:
    """Return the five joints; the first three are the bench's."""
    robot, arm = plant.robot, plant.right_arm
    low, high = robot.l56 + arm.lower, robot.l56 + arm.upper

    def turning(name: str, parent: str, child: str, x: float, actuator: Actuator) -> Hinge:
        return Hinge(name, "revolute", parent, child, x, actuator.lower - _SLACK, actuator.upper + _SLACK)

    return [
        turning("shoulder", "swing_plane", "shoulder_link", 0.0, plant.shoulder),
        Hinge("arm", "revolute", "shoulder_link", "left_arm", robot.l12, pi, 2 * pi),
        turning("wrist", "left_arm", "club", robot.l23, plant.wrist),
        Hinge("rod", "revolute", "left_arm", "right_arm_rod", robot.l23, 0.0, 2 * pi),
        Hinge("cylinder", "prismatic", "right_arm_rod", "right_arm_cylinder", 0.0, low / 2, 2 * high),
    ]


def write_urdf(folder: Path, plant: PlantParameters, min_frame_distance: float) -> list[Path]:
    """Write `golfbench.urdf`, its meshes and `closure.json` into `folder`; return the files.

    `min_frame_distance` is the envelope's (m).

    Raises NotStored if one cannot be written.
    """
    (folder / MESHES).mkdir(parents=True, exist_ok=True)
    drawing = draw(plant)
    robot = Element("robot", name="golfbench")
    extension = SubElement(robot, "mujoco")  # settings that URDF lacks: gravity, and the folder of the meshes
    SubElement(extension, "compiler", meshdir=MESHES, fusestatic="false", balanceinertia="false")
    SubElement(extension, "option", gravity=f"0 0 {-plant.robot.gravity!r}")
    files: list[Path] = []
    _link(robot, "ground")
    for body in drawing.fixed:
        files += _visuals(_link(robot, body.name), folder, body)
        _fixed(robot, "ground", body.name, rotation=Y_UP_TO_Z_UP)
    axes, origin = plane_to_golf(plant.robot, plant.site)
    plane = _link(robot, "swing_plane")
    frame = SubElement(plane, "collision")
    _origin(frame)
    _cylinder(frame, min_frame_distance, _FRAME_LENGTH)
    _fixed(robot, "ground", "swing_plane", Y_UP_TO_Z_UP @ origin, Y_UP_TO_Z_UP @ axes)
    for body in drawing.fixed_in_plane:
        files += _visuals(_link(robot, body.name), folder, body)
        _fixed(robot, "swing_plane", body.name)
    for body in drawing.moving:
        if body.assumed is not None:  # the wrist's piston rod has no joint that URDF could express
            link = _link(robot, body.name)
            _inertial(link, body, body.assumed)
            files += _visuals(link, folder, body)
            if body.name == "club":
                _club_outline(link, plant)
    for hinge in joints(plant):
        _joint(robot, hinge)
    ends = {"shoulder_link": (-plant.robot.l16, 0.0, 0.0), "right_arm_cylinder": (0.0, 0.0, 0.0)}
    for name, (parent, at) in zip(CLOSURE, ends.items(), strict=True):
        _link(robot, name)
        _fixed(robot, parent, name, at)
    # The loop, which URDF cannot express, and the meaning of the joints' efforts.
    closure = {
        "kind": "point",
        "links": CLOSURE,
        "bodies": list(ends),
        "points_m": list(ends.values()),
        "gravity_m_per_s2": [0.0, 0.0, -plant.robot.gravity],
        "efforts": {"shoulder": "N m", "wrist": "N m", "cylinder": "N, positive lengthens the right arm"},
    }
    indent(robot)
    urdf, loop = folder / "golfbench.urdf", folder / "closure.json"
    with atomic_file(urdf) as stream:
        ElementTree(robot).write(stream, encoding="utf-8", xml_declaration=True)
    write_whole(loop, json.dumps(closure, indent=2).encode() + b"\n")
    return [*files, urdf, loop]


def _link(robot: Element, name: str) -> Element:
    return SubElement(robot, "link", name=name)


def _inertial(link: Element, body: DrawnBody, assumed: Body | Club) -> None:
    """Add mass, centre of mass and inertia of the dynamics.

    They have one moment of inertia, about z. The other two do not matter in a plane: they are the drawn
    body's, scaled alike, so that the tensor is a possible one.
    """
    drawn = np.diag(body.weighed.inertia)
    xx, yy, zz = (float(value) * assumed.inertia / float(drawn[2]) for value in drawn)
    inertial = SubElement(link, "inertial")
    _origin(inertial, (assumed.centre_of_mass, 0.0, 0.0))
    SubElement(inertial, "mass", value=repr(float(assumed.mass)))
    tensor = {"ixx": xx, "iyy": max(yy, zz - xx), "izz": float(assumed.inertia)}
    tensor |= dict.fromkeys(("ixy", "ixz", "iyz"), 0.0)
    SubElement(inertial, "inertia", {key: repr(value) for key, value in tensor.items()})


def _visuals(link: Element, folder: Path, body: DrawnBody) -> list[Path]:
    """Add one mesh for each material of a body; write it."""
    files = []
    for colour, parts in by_colour(body).items():
        name = parts[0].material.name.replace(" ", "_")
        path = folder / MESHES / f"{body.name}_{name}.stl"
        write_stl(path, joined_meshes([part.solid.mesh for part in parts]))
        files.append(path)
        visual = SubElement(link, "visual")
        SubElement(SubElement(visual, "geometry"), "mesh", filename=f"{MESHES}/{path.name}")
        rgba = " ".join(f"{value / 255:.4f}" for value in colour)
        SubElement(SubElement(visual, "material", name=f"{body.name}_{name}"), "color", rgba=f"{rgba} 1")
    return files


def _cylinder(collision: Element, radius: float, length: float) -> None:
    SubElement(SubElement(collision, "geometry"), "cylinder", radius=repr(radius), length=repr(length))


def _origin(element: Element, xyz: Any = (0.0,) * 3, rpy: Any = (0.0,) * 3) -> None:
    place, turned = (" ".join(repr(float(value)) for value in values) for values in (xyz, rpy))
    SubElement(element, "origin", xyz=place, rpy=turned)


def _club_outline(link: Element, plant: PlantParameters) -> None:
    """Add the club of the clearance checks: its line, and the ball whose lowest point is the sole."""
    length, radius = plant.robot.club.length_to_face, plant.robot.club.shaft_radius
    shaft, sole = SubElement(link, "collision"), SubElement(link, "collision")
    _origin(shaft, (length / 2, 0.0, 0.0), rpy=(0.0, pi / 2, 0.0))
    _cylinder(shaft, radius, length)
    _origin(sole, (length, 0.0, 0.0))
    SubElement(SubElement(sole, "geometry"), "sphere", radius=repr(plant.site.sole_depth))


def _fixed(robot: Element, parent: str, child: str, at: Any = (0.0,) * 3, rotation: Any = NO_TURN) -> None:
    joint = SubElement(robot, "joint", name=f"{child}_fixed", type="fixed")
    _origin(joint, at, Rotation.from_matrix(rotation).as_euler("xyz"))
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)


def _joint(robot: Element, hinge: Hinge) -> None:
    joint = SubElement(robot, "joint", name=hinge.name, type=hinge.kind)
    # The cylinder looks from R6 back to R3, against its way.
    back = hinge.kind == "prismatic"
    _origin(joint, (hinge.x, 0.0, 0.0), rpy=(0.0, 0.0, pi * back))
    SubElement(joint, "parent", link=hinge.parent)
    SubElement(joint, "child", link=hinge.child)
    SubElement(joint, "axis", xyz="-1 0 0" if back else "0 0 1")
    limits = {"lower": hinge.lower, "upper": hinge.upper, "effort": EFFORT, "velocity": SPEED}
    SubElement(joint, "limit", {key: repr(float(value)) for key, value in limits.items()})


REASONS = {
    "shoulder_link": "bar exact; its bores and the pins of R2 and R6 are not in the dynamics",
    "left_arm": "bar, plate and cylinder exact; the bores of R2 and R3 are not in the dynamics",
    "club": "the dynamics hold mount and head as points on the shaft's line, the head at the shaft's end",
    "right_arm_rod": "rod, piston and eye over the whole stroke; the thesis has the inertia of a 0.2 m rod",
    "right_arm_cylinder": "caps at both ends; the thesis has a uniform bar",
}
"""Cause of a difference, by body."""


class MassRow(NamedTuple):
    """One body: assumed in the dynamics, drawn in its frame. Central inertia about the plane's normal."""

    body: str
    mass_assumed_kg: float
    mass_drawn_kg: float
    com_x_assumed_m: float
    com_x_drawn_m: float
    com_y_drawn_m: float
    inertia_assumed_kg_m2: float
    inertia_drawn_kg_m2: float
    pins_kg: float
    """Mass of pins less that of bores, in the drawn mass."""
    reason: str


def mass_rows(plant: PlantParameters) -> list[MassRow]:
    """Return a row for each body of the dynamics."""
    rows = []
    for body in draw(plant).moving:
        if (assumed := body.assumed) is not None:
            drawn, (x, y, _) = body.weighed, body.weighed.centroid.tolist()
            masses, inertias = (assumed.mass, drawn.volume), (assumed.inertia, float(drawn.inertia[2, 2]))
            pins = drawn.volume - body.without_joints.volume
            about = pins, REASONS[body.name]
            rows.append(MassRow(body.name, *masses, assumed.centre_of_mass, x, y, *inertias, *about))
    return rows


def write_mass_table(path: Path, rows: list[MassRow]) -> None:
    """Write `rows` as CSV to `path`, units in the column names. Raises NotStored."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(MassRow._fields)
    writer.writerows(rows)
    write_whole(path, text.getvalue())


_MM = 1000.0


def load_build123d() -> Any:
    """Return the package. Raises BenchError if it is not installed."""
    return load_extra("build123d", "cad", "draw --format step", "; glTF and URDF need nothing more")


def _location(b: Any, turn: Any, at: Any) -> Any:
    """Return the place of a rotation matrix and a point (mm)."""
    rotation = np.array(turn)
    x, z = (tuple(map(float, rotation[:, axis])) for axis in (0, 2))
    return b.Plane(origin=tuple(map(float, at)), x_dir=x, z_dir=z).location


def solid_shape(b: Any, solid: Solid) -> Any:
    """Return `solid` as a shape of build123d, `b`, in mm."""
    match solid:
        case Bar():
            shape = b.Solid.make_box(*(_MM * size for size in solid.size))
            shape = shape.moved(b.Location(tuple(-_MM * size / 2 for size in solid.size)))
            height = _MM * solid.size[2]
            for bore in solid.bores:
                drill = b.Solid.make_cylinder(_MM * bore.radius, 2 * height)
                shape = shape.cut(drill.moved(b.Location((_MM * bore.x, _MM * bore.y, -height))))
            return shape.moved(_location(b, solid.turn, _MM * np.array(solid.centre)))
        case Tube():
            way = tuple(map(float, np.array(solid.end) - np.array(solid.start)))
            shape = b.Solid.make_cylinder(_MM * solid.outer, _MM * solid.length)
            if solid.inner > 0:
                shape = shape.cut(b.Solid.make_cylinder(_MM * solid.inner, _MM * solid.length))
            return shape.moved(b.Plane(origin=tuple(_MM * v for v in solid.start), z_dir=way).location)
        case Ellipsoid(cut=None) if len(set(solid.half)) == 1:
            ball = b.Solid.make_sphere(_MM * solid.half[0], angle1=-90, angle2=90, angle3=360)
            return ball.moved(b.Location(tuple(_MM * value for value in solid.centre)))
        case Ellipsoid():
            # Faceted: CAD programs misread the surfaces of scaled spheres.
            corners = _MM * solid.mesh.vertices[solid.mesh.triangles]
            wires = [b.Wire.make_polygon([tuple(map(float, c)) for c in triangle]) for triangle in corners]
            return b.Solid(b.Shell(list(map(b.Face, wires))))


def step_assembly(b: Any, bodies: Sequence[PlacedBody]) -> Any:
    """Return the bodies as a labelled, coloured assembly; `b` is build123d."""
    assemblies = []
    for one in bodies:
        location = _location(b, Y_UP_TO_Z_UP @ one.turn, _MM * (Y_UP_TO_Z_UP @ one.at))
        children = []
        for part in one.body.parts:
            (solid,) = solid_shape(b, part.solid).solids()
            shape = solid.moved(location)
            shape.label = part.name
            shape.color = b.Color(*(value / 255 for value in part.material.colour))
            children.append(shape)
        assemblies.append(b.Compound(label=one.body.name, children=children))
    return b.Compound(label="golfbench", children=assemblies)


def write_step(path: Path, bodies: Sequence[PlacedBody]) -> None:
    """Write the bodies to `path`. Raises NotStored, BenchError without build123d."""
    b = load_build123d()
    assembly = step_assembly(b, bodies)
    with atomic_path(path) as partial:
        b.export_step(assembly, str(partial))

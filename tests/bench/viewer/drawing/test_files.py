"""Other programs read the files: STEP by its own kernel, glTF by trimesh; the command writes them all."""

from __future__ import annotations

import csv
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.testing

from bench.base.errors import BenchError
from bench.commands.cli import app
from bench.commands.common import Session
from bench.viewer.drawing.bodies import DrawnBody, Ellipsoid, Part
from bench.viewer.drawing.drawing import draw, placed
from bench.viewer.drawing.model_files import (
    MassRow,
    gltf,
    load_build123d,
    mass_rows,
    solid_shape,
    write_step,
)
from sim.plant import PlantParameters
from tests.bench.viewer.drawing.conftest import PLANTS, mesh_volume

MM3 = 1e-9


def bodies(plant: PlantParameters) -> list[DrawnBody]:
    return [body for group in draw(plant) for body in group]


def build123d() -> Any:
    return pytest.importorskip("build123d", reason="needs build123d (pip install '.[cad]')")


# glTF ------------------------------------------------------------------------------------------------


def content(file: bytes) -> dict[str, Any]:
    """The JSON part of a binary glTF file."""
    magic, version, length = struct.unpack("<III", file[:12])
    size, kind = struct.unpack("<II", file[12:20])
    assert (magic, version, length, kind) == (0x46546C67, 2, len(file), 0x4E4F534A)
    found: dict[str, Any] = json.loads(file[20 : 20 + size])
    return found


def test_gltf_contains_every_placed_body(plant: PlantParameters) -> None:
    found = content(gltf(placed(plant)))
    assert [node["name"] for node in found["nodes"]] == [one.body.name for one in placed(plant)]
    assert all(view["byteOffset"] % 4 == 0 for view in found["bufferViews"])


@pytest.mark.release
def test_gltf_read_by_trimesh_has_same_bounds(shipped: PlantParameters, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="needs trimesh (pip install '.[benchmark]')")
    everything = placed(shipped)
    (tmp_path / "robot.glb").write_bytes(gltf(everything))
    scene = trimesh.load(tmp_path / "robot.glb")
    low = np.min([one.mesh.vertices.min(axis=0) for one in everything], axis=0)
    high = np.max([one.mesh.vertices.max(axis=0) for one in everything], axis=0)
    assert scene.bounds == pytest.approx(np.array([low, high]), abs=1e-5)


# STEP ------------------------------------------------------------------------------------------------


def exact(part: Part) -> float:
    """Volume in STEP (m3): a club's head has flat facets there."""
    ball = part.name == "ball" or not isinstance(part.solid, Ellipsoid)
    return part.solid.volume.volume if ball else mesh_volume(part.solid.mesh)


@pytest.mark.release
@pytest.mark.parametrize("name", ["shipped", "iron7"])
def test_solid_shape_has_stated_volume_and_centroid(name: str) -> None:
    b = build123d()
    for body in bodies(PLANTS[name]):
        for part in body.parts:
            shape = solid_shape(b, part.solid)
            assert shape.volume * MM3 == pytest.approx(exact(part), rel=1e-6), part.name
            centre = np.array([*shape.center(b.CenterOf.MASS)]) / 1000
            near = 1e-3 if isinstance(part.solid, Ellipsoid) else 1e-6
            assert centre == pytest.approx(part.solid.volume.centroid, abs=near), part.name


@pytest.mark.release
def test_step_reads_back_with_names_and_volume(shipped: PlantParameters, tmp_path: Path) -> None:
    b = build123d()
    everything = placed(shipped)
    write_step(tmp_path / "robot.step", everything)
    read = b.import_step(str(tmp_path / "robot.step"))
    parts = [part for one in everything for part in one.body.parts]
    assert len(read.solids()) == len(parts)
    total = sum(map(exact, parts))
    assert sum(solid.volume for solid in read.solids()) * MM3 == pytest.approx(total, rel=1e-6)
    assert {child.label for child in read.children} == {one.body.name for one in everything}
    assert [path.name for path in tmp_path.iterdir()] == ["robot.step"]


def test_load_build123d_missing_names_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "build123d", None)
    with pytest.raises(BenchError, match=r"golfbench\[cad\]"):
        load_build123d()


# Masses ----------------------------------------------------------------------------------------------


def test_mass_rows_cover_every_body_of_dynamics(plant: PlantParameters) -> None:
    rows = {row.body: row for row in mass_rows(plant)}
    robot = plant.robot
    assumed = (robot.shoulder_link, robot.left_arm, robot.club, robot.rod, robot.cylinder)
    assert sum(row.mass_assumed_kg for row in rows.values()) == pytest.approx(sum(b.mass for b in assumed))
    for row in rows.values():
        assert row.mass_drawn_kg == pytest.approx(row.mass_assumed_kg, rel=0.01)
        assert row.com_x_drawn_m == pytest.approx(row.com_x_assumed_m, abs=0.02)
        assert row.reason


# The command -----------------------------------------------------------------------------------------


def drawn(folder: Path, *arguments: str) -> str:
    runner = typer.testing.CliRunner()
    result = runner.invoke(app, ["draw", "--output", str(folder), *arguments], obj=Session())
    assert result.exit_code == 0, result.output
    return result.output


def test_draw_command_without_cad_extra_writes_other_formats(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    said = drawn(tmp_path / "new" / "folder")
    names = {path.name for path in (tmp_path / "new" / "folder").iterdir()}
    assert names == {"robot.glb", "golfbench.urdf", "closure.json", "masses.csv", "meshes"}
    assert "golfbench[cad]" in said
    with (tmp_path / "new" / "folder" / "masses.csv").open(newline="") as stream:
        header, *rows = csv.reader(stream)
    assert tuple(header) == MassRow._fields
    assert [row[0] for row in rows] == [body.name for body in draw_order()]


def draw_order() -> list[DrawnBody]:
    return [body for body in draw(PlantParameters()).moving if body.assumed is not None]


def test_draw_command_other_club_changes_gltf(tmp_path: Path) -> None:
    drawn(tmp_path / "driver", "--format", "gltf")
    drawn(tmp_path / "iron", "--format", "gltf", "--club", "iron7")
    names = [{path.name for path in (tmp_path / name).iterdir()} for name in ("driver", "iron")]
    assert names == [{"robot.glb", "masses.csv"}] * 2
    assert (tmp_path / "driver" / "robot.glb").read_bytes() != (tmp_path / "iron" / "robot.glb").read_bytes()

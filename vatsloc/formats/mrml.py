"""A scene.mrml for 3D Slicer: volumes, models, points and transforms that lie in files, placed in one frame.

Matrices in a scene are RAS mm and map a node's points to its parent's ("to parent"); transform files hold the way back.
Ref: Slicer developer guide, MRML overview; vtkMRMLLinearTransformNode, vtkMRMLTransformStorageNode.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote
from xml.etree import ElementTree as ET

import numpy as np

from registration.volume import Array

WINDOW_HU = (-1000.0, 250.0)
_SLICES = ("Red", "Yellow", "Green")


@dataclass(frozen=True)
class Frame:
    """A linear transform. to_parent_ras: (4, 4), mm; parent: name of the frame it leads to, None for the world."""

    name: str
    to_parent_ras: Array
    parent: str | None = None


@dataclass(frozen=True)
class VolumeFile:
    """An image in a frame; label: whether its voxels are labels."""

    name: str
    path: Path
    frame: str | None = None
    label: bool = False


@dataclass(frozen=True)
class ModelFile:
    """A mesh in LPS, in a frame; colour: "#rrggbb"."""

    name: str
    path: Path
    colour: str
    opacity: float = 1.0
    visible: bool = True
    frame: str | None = None


@dataclass(frozen=True)
class PointsFile:
    """Markups in a frame; colour: "#rrggbb"."""

    name: str
    path: Path
    colour: str
    frame: str | None = None


@dataclass(frozen=True)
class FieldFile:
    """A displacement field as ITK resamples by it: from the parent's points back to those of what is transformed."""

    name: str
    path: Path


Item = Frame | VolumeFile | ModelFile | PointsFile | FieldFile


def write_scene(
    path: Path, items: Sequence[Item], folder: Path, background: str, foreground: str, note: str = ""
) -> None:
    """Write a scene whose files are named relative to `folder`, where it will lie; two volumes fill the slice views.

    note: a comment at its head. Raises ValueError for a frame or a volume that no item has.
    """
    root = ET.Element("MRML", version="Slicer 5.0.0", userTags="")
    if note:
        root.append(ET.Comment(f" {note.replace('--', '- -')} "))
    scene = _Scene(root, folder.resolve(), {i.name: f"vtkMRMLLinearTransformNode{n}" for n, i in _frames(items)})
    volumes: dict[str, str] = {}
    for number, item in enumerate(items, 1):
        match item:
            case Frame():
                scene.frame(item)
            case VolumeFile():
                volumes[item.name] = scene.volume(item, number)
            case ModelFile():
                scene.model(item, number)
            case PointsFile():
                scene.points(item, number)
            case FieldFile():
                scene.field(item, number)
    for name in (background, foreground):
        if name not in volumes:
            raise ValueError(f'"{name}" is no volume of the scene; it has {", ".join(volumes)}')
    for view in _SLICES:
        shown = {"backgroundVolumeID": volumes[background], "foregroundVolumeID": volumes[foreground]}
        fixed = {"singletonTag": view, "layoutName": view, "foregroundOpacity": "0", "linkedControl": "1"}
        scene.add("SliceComposite", f"vtkMRMLSliceCompositeNode{view}", "SliceComposite", **fixed, **shown)
    ET.indent(root, " ")
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _frames(items: Sequence[Item]) -> list[tuple[int, Frame]]:
    return [(n, item) for n, item in enumerate(items, 1) if isinstance(item, Frame)]


@dataclass(frozen=True)
class _Scene:
    root: ET.Element
    folder: Path
    frames: dict[str, str]

    def add(self, tag: str, identity: str, name: str, references: str = "", **attributes: str) -> str:
        """A node of the scene; returns its id."""
        if references:
            attributes["references"] = references
        ET.SubElement(self.root, tag, {"id": identity, "name": name, **attributes})
        return identity

    def frame(self, item: Frame) -> None:
        matrix = " ".join(repr(float(v)) for v in np.asarray(item.to_parent_ras).ravel())
        parent = self._placed(item.parent)
        self.add("LinearTransform", self.frames[item.name], item.name, parent, matrixTransformToParent=matrix)

    def volume(self, item: VolumeFile, n: int) -> str:
        kind, tag, shown = "ScalarVolume", "Volume", "VolumeDisplay"
        colours = "vtkMRMLColorTableNodeGrey"
        if item.label:
            kind, tag, shown = "LabelMapVolume", "LabelMapVolume", "LabelMapVolumeDisplay"
            colours = "vtkMRMLColorTableNodeFileGenericColors.txt"
        low, high = WINDOW_HU
        window = {} if item.label else {"window": f"{high - low:g}", "level": f"{(low + high) / 2:g}"}
        if window:
            window["autoWindowLevel"] = "0"
        display = self.add(shown, f"vtkMRML{kind}DisplayNode{n}", f"{item.name} display", colorNodeID=colours, **window)
        storage = self._stored("VolumeArchetypeStorage", item.path, item.name, n, centerImage="0")
        return self.add(tag, f"vtkMRML{kind}Node{n}", item.name, self._references(display, storage, item.frame))

    def model(self, item: ModelFile, n: int) -> None:
        display = self.add(
            "ModelDisplay",
            f"vtkMRMLModelDisplayNode{n}",
            f"{item.name} display",
            color=_rgb(item.colour),
            opacity=f"{item.opacity:g}",
            visibility="true" if item.visible else "false",
            visibility2D="true" if item.visible else "false",
        )
        storage = self._stored("ModelStorage", item.path, item.name, n, coordinateSystem="LPS")
        self.add("Model", f"vtkMRMLModelNode{n}", item.name, self._references(display, storage, item.frame))

    def points(self, item: PointsFile, n: int) -> None:
        colour = _rgb(item.colour)
        display = self.add(
            "MarkupsFiducialDisplay",
            f"vtkMRMLMarkupsFiducialDisplayNode{n}",
            f"{item.name} display",
            color=colour,
            selectedColor=colour,
        )
        storage = self._stored("MarkupsJsonStorage", item.path, item.name, n, coordinateSystem="LPS")
        references = self._references(display, storage, item.frame)
        self.add("MarkupsFiducial", f"vtkMRMLMarkupsFiducialNode{n}", item.name, references)

    def field(self, item: FieldFile, n: int) -> None:
        storage = self._stored("TransformStorage", item.path, item.name, n)
        self.add("GridTransform", f"vtkMRMLGridTransformNode{n}", item.name, f"storage:{storage};")

    def _stored(self, tag: str, path: Path, name: str, n: int, **attributes: str) -> str:
        relative = os.path.relpath(path.resolve(), self.folder).replace(os.sep, "/")
        return self.add(tag, f"vtkMRML{tag}Node{n}", f"{name} file", fileName=quote(relative), **attributes)

    def _references(self, display: str, storage: str, frame: str | None) -> str:
        return f"display:{display};storage:{storage};{self._placed(frame)}"

    def _placed(self, frame: str | None) -> str:
        if frame is None:
            return ""
        if frame not in self.frames:
            raise ValueError(f'"{frame}" is no frame of the scene; it has {", ".join(self.frames)}')
        return f"transform:{self.frames[frame]};"


def _rgb(colour: str) -> str:
    """ "#rrggbb" as three numbers from 0 to 1."""
    return " ".join(f"{int(colour[at : at + 2], 16) / 255:.3f}" for at in (1, 3, 5))

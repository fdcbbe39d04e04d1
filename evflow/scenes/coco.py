"""Object masks of a COCO json: polygons, and run-length codes packed or plain, crowds marked.

The json is checked when it is read, as far as it describes itself; images and masks are decoded
when they are asked for. A point (x, y) is measured from the image's top left corner, so that the
centre of its first pixel is (.5, .5); a pixel belongs to a polygon that holds its centre.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from evflow.errors import EvflowDataError
from evflow.files.json_text import parse_json
from evflow.files.limits import read_whole
from evflow.io.images.frames import existing
from evflow.scenes.rle import decode_rle

MAX_PIXELS = 1 << 28  # of an image: its mask takes a byte each


@dataclasses.dataclass(frozen=True)
class CocoObject:
    """One annotation. image: its file; size (width, height); area in pixels, as the json has it;
    crowd: several objects under one mask; where: its name in messages."""

    image: str
    size: tuple[int, int]
    segmentation: Any
    area: float
    category: str
    crowd: bool
    where: str

    def mask(self) -> np.ndarray:
        """Bool (H, W). Raises EV002 (a polygon of less than 3 points or of odd length, an RLE of
        another size), EV003 (not numbers), EV009 (a damaged RLE)."""
        width, height = self.size
        if not isinstance(self.segmentation, dict):
            return self._filled((height, width))
        size = self.segmentation.get("size")
        if size != [height, width]:
            raise EvflowDataError(
                "EV002", f"{self.where}: its RLE is of size {size}, its image of "
                f"{[height, width]} (height, width).", "Scaled images? Scale the masks too.")
        return decode_rle(self.segmentation["counts"], (height, width), self.where)

    def _filled(self, shape: tuple[int, int]) -> np.ndarray:
        from skimage.draw import polygon

        mask = np.zeros(shape, bool)
        for points in self.segmentation:
            corners = _corners(points, self.where)
            mask[polygon(corners[:, 1] - 0.5, corners[:, 0] - 0.5, shape)] = True
        return mask


@dataclasses.dataclass(frozen=True)
class Coco:
    """The objects of a json, and the folder of its images."""

    path: Path
    folder: Path
    objects: tuple[CocoObject, ...]

    def image_path(self, name: str) -> Path:
        """The file of an image, or EV016 with how many are there."""
        path = self.folder / name
        if not path.is_file():
            names = sorted({o.image for o in self.objects})
            there = sum((self.folder / n).is_file() for n in names)
            raise EvflowDataError(
                "EV016", f"{self.path} names {name}, which is not in {self.folder} ({there:,} of "
                f"{len(names):,} images are).", f"Move the images there, or into "
                f"{self.path.parent / 'images'}; in Python, images= is their folder.")
        return path


def read_coco(path: str | os.PathLike, images: str | os.PathLike | None = None) -> Coco:
    """Read a COCO json of objects. images: their folder; None = that of the json, or `images`
    in it.

    Raises EV008 (no COCO json), EV009 (damaged json), EV016 (not there), EV020 (an image file
    outside the folder).
    """
    path = existing(path)
    try:
        data = parse_json(read_whole(path))
    except (OSError, ValueError) as e:
        raise EvflowDataError(
            "EV009", f"{path} is not sound JSON ({e}).", "Cut off? Copy it again.") from e
    missing = [k for k in ("images", "annotations")
               if not isinstance(data, dict) or not isinstance(data.get(k), list)]
    if missing:
        raise EvflowDataError(
            "EV008", f"{path} is no COCO json: it has no list {' and no list '.join(missing)}.",
            "Expected images, annotations and categories.")
    if images is not None:
        folder = existing(images)
    else:
        beside = path.parent / "images"
        folder = beside if beside.is_dir() else path.parent
    return Coco(path, folder, _objects(path, data))


def _objects(path: Path, data: dict[str, Any]) -> tuple[CocoObject, ...]:
    """The annotations that have a segmentation; EV008, EV020 where a field is not as it must."""
    number, image, where = 0, {}, ""
    try:
        for number, entry in enumerate(data["images"]):
            where = f"{path}, image {number}"
            name, size = str(entry["file_name"]), (int(entry["width"]), int(entry["height"]))
            if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
                raise EvflowDataError(
                    "EV020", f"{where} is {name}, which leaves the folder of the images.")
            if min(size) < 1 or size[0] * size[1] > MAX_PIXELS:
                raise ValueError(f"{size[0]}x{size[1]} pixels")
            image[entry["id"]] = name, size
        where = f"{path}, categories"
        names = {c["id"]: str(c["name"]) for c in data.get("categories", [])}
        found = []
        for number, entry in enumerate(data["annotations"]):
            where = f"{path}, annotation {number} (id {entry.get('id')})"
            shape = entry.get("segmentation")
            if not shape:
                continue  # a box or keypoints alone
            if not isinstance(shape, list) and "counts" not in shape:
                raise KeyError("counts")
            name, size = image[entry["image_id"]]
            found.append(CocoObject(
                name, size, shape, float(entry.get("area", np.nan)),
                names.get(entry.get("category_id"), ""), bool(entry.get("iscrowd", 0)), where))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as e:
        raise EvflowDataError(
            "EV008", f"{where} lacks or misstates a field ({type(e).__name__}: {e}).",
            "Images need id, file_name, width, height; annotations image_id, segmentation.") from e
    return tuple(found)


def _corners(points: Any, where: str) -> np.ndarray:
    """A polygon's corners (N, 2) = (x, y), N >= 3."""
    try:
        flat = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        flat = np.full(1, np.nan)
    if not np.isfinite(flat).all():
        raise EvflowDataError("EV003", f"{where}: a polygon is {str(points)[:60]}.",
                              "Expected numbers x, y, x, y, ...")
    if flat.ndim != 1 or flat.size < 6 or flat.size % 2:
        raise EvflowDataError(
            "EV002", f"{where}: a polygon has {flat.size} numbers.",
            "Expected x, y of at least 3 points; drop it, or export the masks again.")
    return flat.reshape(-1, 2)

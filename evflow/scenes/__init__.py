"""Synthetic moving scenes for training, rendered on the device.

`make_bank` draws textures once, `folder_bank` and `coco_bank` take them from your own pictures;
`sample_scene` and `render` are pure and batch by vmap.
"""

from evflow.scenes.bank import TextureBank, make_bank
from evflow.scenes.coco import Coco, CocoObject, read_coco
from evflow.scenes.config import SceneConfig
from evflow.scenes.photos import load_photos
from evflow.scenes.render import Layer, Scene, render, sample_scene
from evflow.scenes.sources import coco_bank, folder_bank, join_banks, load_folder, own_bank
from evflow.scenes.trajectory import Trajectory

__all__ = [
    "Coco",
    "CocoObject",
    "Layer",
    "Scene",
    "SceneConfig",
    "TextureBank",
    "Trajectory",
    "coco_bank",
    "folder_bank",
    "join_banks",
    "load_folder",
    "load_photos",
    "make_bank",
    "own_bank",
    "read_coco",
    "render",
    "sample_scene",
]

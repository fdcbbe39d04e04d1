"""Synthetic moving scenes, rendered on the device: what training cameras look at.

`make_bank` draws textures once; `sample_scene` and `render` are pure and batch by vmap.
"""

from evflow.scenes.bank import TextureBank, make_bank
from evflow.scenes.config import SceneConfig
from evflow.scenes.photos import load_photos
from evflow.scenes.render import Layer, Scene, render, sample_scene
from evflow.scenes.trajectory import Trajectory

__all__ = [
    "Layer",
    "Scene",
    "SceneConfig",
    "TextureBank",
    "Trajectory",
    "load_photos",
    "make_bank",
    "render",
    "sample_scene",
]

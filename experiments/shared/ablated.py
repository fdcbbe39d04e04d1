"""What `experiments.ablate` compares: training configurations that differ in one thing."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

from evflow.network.config import ModelConfig
from evflow.training.config import PARTS, PRESETS, LossConfig, TrainConfig

Study = Literal["losses", "steps", "networks"]
FLOW_STEPS = (8, 12, 16, 20, 24)


def base_config(steps: int, small: bool) -> TrainConfig:
    """The paper's network and cameras, in crops that a core trains eight times as fast."""
    config = dataclasses.replace(
        PRESETS["paper"], crop=32, block=(8, 8), scenes=2 if small else 8, cameras=2, steps=steps,
        warmup=min(100, steps // 5), textures=16 if small else 192)
    if not small:
        return config
    flow = dataclasses.replace(config.model.flow, steps=2)
    return dataclasses.replace(config, model=dataclasses.replace(config.model, flow=flow),
                               steps_per_window=16)


def chosen(study: Study, base: TrainConfig) -> dict[str, TrainConfig]:
    """Training configurations by name, the one that the others are compared to first."""
    def losses(**changes: Any) -> TrainConfig:
        return dataclasses.replace(base, loss=dataclasses.replace(base.loss, **changes))

    def steps(k: int) -> TrainConfig:
        return dataclasses.replace(base, model=dataclasses.replace(
            base.model, flow=dataclasses.replace(base.model.flow, steps=k)))

    if study == "losses":
        plain = {"adaptive": False}
        return {"L_P": losses(flow=0.0, inverse_flow=0.0, event=0.0, **plain),
                "L_P + L_F": losses(inverse_flow=0.0, event=0.0, **plain),
                "L_P + L_F + L_F'": losses(event=0.0, **plain),
                "L_P + L_E": losses(flow=0.0, inverse_flow=0.0, **plain),
                "L_P + L_F + L_F' + L_E": losses(**plain),
                "the same, weights adapted": base}
    if study == "steps":
        return {f"{k} steps": steps(k) for k in FLOW_STEPS}
    ours = ModelConfig()
    ours = dataclasses.replace(ours, flow=dataclasses.replace(
        ours.flow, steps=base.model.flow.steps))
    return {"paper": base, "default": dataclasses.replace(
        base, model=ours, loss=LossConfig(), parts=PARTS)}

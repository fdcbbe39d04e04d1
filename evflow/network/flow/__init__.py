"""The conditional normalizing flow (paper, Section IV-B and IV-C): pure functions on params."""

from __future__ import annotations

from evflow.network.flow.config import FlowConfig
from evflow.network.flow.folding import fold, forward_columns, forward_folded, settle
from evflow.network.flow.stack import data_init, forward, init, inverse

__all__ = [
    "FlowConfig", "data_init", "fold", "forward", "forward_columns", "forward_folded", "init",
    "inverse", "settle",
]

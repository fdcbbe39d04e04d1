"""Numbers of a sensor model: those that are on are leaves of a pytree, and may be traced."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from evflow.checks import require


def is_off(value: Any) -> bool:
    """Whether a number is known to be 0: a traced one may have any value."""
    return isinstance(value, int | float | np.number) and value == 0


def settle(config: Any, name: str, low: float, rule: str) -> None:
    """Turn a numeric field into a float; raises EV020 unless it is finite and at least `low`.
    Of traced numbers, which cannot raise, such ones become NaN."""
    value = getattr(config, name)
    require(config, name, np.ndim(value) == 0, "one number; jax.vmap takes several")
    if isinstance(value, jax.core.Tracer):
        good = jnp.isfinite(value) & (value >= low)
        object.__setattr__(config, name, jnp.where(good, value, jnp.nan))
        return
    number = np.asarray(value).dtype.kind in "biuf"
    require(config, name, number and bool(np.isfinite(value)) and value >= low, rule)
    object.__setattr__(config, name, float(value))


class Numbers:
    """A frozen dataclass as a pytree whose leaves are the fields named in `leaves`, which is
    decided at construction. Unflattening checks nothing: JAX also puts tangents and placeholders
    back."""

    leaves: tuple[str, ...]

    def tree_flatten_with_keys(self) -> tuple[tuple[tuple[Any, Any], ...], Any]:
        """Leaves with their names, and everything else, including `leaves`."""
        leaves = tuple((jax.tree_util.GetAttrKey(n), getattr(self, n)) for n in self.leaves)
        return leaves, tuple((n, v) for n, v in vars(self).items() if n not in self.leaves)

    @classmethod
    def tree_unflatten(cls, structure: Any, leaves: Any) -> Any:
        """Rebuild the dataclass."""
        made = object.__new__(cls)
        vars(made).update(structure)
        vars(made).update(zip(made.leaves, leaves, strict=True))
        return made

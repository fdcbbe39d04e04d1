"""Data parallelism: one program for a CPU, a GPU, many devices, many hosts.

All devices of all processes form one mesh axis, "data". The state is replicated and a batch is
sharded by scene: XLA partitions the step and sums the gradients. The step's code stays global (it
sees whole batches); only loops over sequences, which XLA would run whole on every device, run under
`by_shard`. The mesh is ambient while a `parallel` function runs; without one, everything runs as
written. `initialise` must come before any other use of JAX.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from evflow.errors import EvflowDataError

AXIS = "data"
# If a process dies, the others end within the heartbeat; one that fails waits for the others at
# exit until the shutdown timeout: 25 s at most, against 400 s with JAX's defaults.
HEARTBEAT_S, SHUTDOWN_S = 10, 15
# Variables set by each launcher; the last one is the number of processes it started.
LAUNCHERS = (
    ("SLURM_JOB_ID", "SLURM_STEP_NODELIST", "SLURM_PROCID", "SLURM_LOCALID", "SLURM_NTASKS"),
    ("OMPI_MCA_orte_hnp_uri", "OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),
)
Common = TypeVar("Common")
Shard = TypeVar("Shard")
Result = TypeVar("Result")


def launched(environ: Mapping[str, str]) -> bool:
    """Whether Slurm (srun) or Open MPI (mpirun) started this process as one of several."""
    return any(all(name in environ for name in names) and int(environ[names[-1]]) > 1
               for names in LAUNCHERS)


def initialise(
    coordinator: str | None = None, processes: int | None = None, process_id: int | None = None
) -> None:
    """Join the other processes of this run, given by the options or else by the launcher; a single
    process does nothing.

    coordinator: HOST:PORT of process 0. Raises EV020 if the options are incomplete or wrong.
    """
    # SIGTERM belongs to the training loop.
    jax.config.update("jax_enable_preemption_service", False)
    given = (coordinator, processes, process_id)
    join = partial(jax.distributed.initialize, heartbeat_timeout_seconds=HEARTBEAT_S,
                   shutdown_timeout_seconds=SHUTDOWN_S)
    if given == (None, None, None):
        if launched(os.environ):
            join()
        return
    if coordinator is None or processes is None or process_id is None:
        raise EvflowDataError(
            "EV020", f"coordinator, processes and process id are {given}.", "Give all three.")
    host, _, port = coordinator.rpartition(":")
    if not (host and port.isdecimal() and 0 <= process_id < processes):
        raise EvflowDataError(
            "EV020", f"coordinator {coordinator!r}, process {process_id} of {processes}.",
            "The coordinator is HOST:PORT of process 0; processes count from 0.")
    join(*given, cluster_detection_method="deactivate")


def is_main() -> bool:
    """Whether this process writes the logs and prints."""
    return jax.process_index() == 0


def agree(vote: bool) -> bool:
    """Whether any process votes yes: all processes wait here and get the same answer."""
    if jax.process_count() == 1:
        return vote
    return bool(np.any(multihost_utils.process_allgather(np.asarray(vote))))


def leave_together() -> None:
    """Leave the run together with all other processes: JAX takes a process that leaves early for
    dead, and ends the others. Nothing runs on several processes afterwards."""
    if jax.process_count() > 1:
        agree(True)
        jax.distributed.shutdown()  # now, as a process that a signal ends runs nothing at its exit


class Votes:
    """`agree` for a loop that keeps the devices busy, without waiting for their work.

    With several processes a vote counts one call later (except the first): every process gets the
    same answer in the same call.
    """

    def __init__(self) -> None:
        mesh = make_mesh()
        self._by_device = NamedSharding(mesh, P(AXIS))
        self._any = jax.jit(jnp.any, out_shardings=NamedSharding(mesh, P()))
        self._asked: jax.Array | None = None

    def agree(self, vote: bool) -> bool:
        """Whether any process voted yes in the previous call; with one process, the vote itself."""
        if jax.process_count() == 1:
            return vote
        votes = jax.make_array_from_callback(
            self._by_device.mesh.devices.shape, self._by_device, lambda _: np.array([vote]))
        before, self._asked = self._asked, self._any(votes)
        return bool(self._asked if before is None else before)


def make_mesh() -> Mesh:
    """All devices of all processes on the axis "data". Auto: XLA chooses the inner shardings."""
    return jax.make_mesh((jax.device_count(),), (AXIS,), axis_types=(AxisType.Auto,))


def replicate(tree: Result, mesh: Mesh) -> Result:
    """A pytree that every process computed for itself, replicated on all devices."""
    sharding = NamedSharding(mesh, P())

    def put(leaf: Any) -> jax.Array:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(
                put(jax.random.key_data(leaf)), impl=jax.random.key_impl(leaf))
        host = np.asarray(leaf)
        return jax.make_array_from_callback(host.shape, sharding, lambda index: host[index])

    return jax.tree.map(put, tree)


def parallel(step: Callable[..., Any], mesh: Mesh) -> jax.stages.Wrapped:
    """step(state, ...) jitted for the mesh: results are replicated, the state's buffers donated."""
    def meshed(*args: Any) -> Any:
        with jax.sharding.use_abstract_mesh(mesh.abstract_mesh):
            return step(*args)

    return jax.jit(meshed, donate_argnums=0, out_shardings=NamedSharding(mesh, P()))


@contextlib.contextmanager
def compiled_quickly(wanted: bool) -> Iterator[None]:
    """If `wanted`, compile programs of this block without optimisation, in half the time, because
    they run only a few times."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", wanted or before)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)


def by_shard(
    f: Callable[[Common, Shard], Result],
) -> Callable[[Common, Shard], Result]:
    """f(common, shard) -> result, run by every device on its share of the leading axis; f itself
    without a mesh.

    common: replicated pytree; shard, result: pytrees whose leaves are split along axis 0. Left to
    itself, XLA runs a loop over sequences (and renders their scenes) whole on every device.
    """
    if jax.sharding.get_abstract_mesh().empty:
        return f
    # check_vma: f's scans start from constants, all of which would have to be marked as varying.
    return jax.shard_map(f, in_specs=(P(), P(AXIS)), out_specs=P(AXIS), check_vma=False)

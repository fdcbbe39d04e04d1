from .config import PRESETS as PRESETS
from .config import DatasetConfig as DatasetConfig
from .generate import make_sequence as make_sequence
from .manifest import verify as verify
from .sequence import EventSequence as EventSequence
from .sequence import sequence_names as sequence_names
from .shards import build as build
from .store import (
    iter_sequences as iter_sequences,
)
from .store import (
    read_sequence as read_sequence,
)
from .store import (
    sequence_paths as sequence_paths,
)
from .store import (
    write_sequence as write_sequence,
)

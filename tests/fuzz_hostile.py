"""Files made to do harm: bombs, lies about sizes, pickles, links, names that lead elsewhere.

`HOSTILE[name](folder)` writes one and says how it is read; every one of them must be refused.
"""

import fuzz_archives
import fuzz_hdf5
import fuzz_headers
from fuzz_registry import HOSTILE

__all__ = ["HOSTILE", "fuzz_archives", "fuzz_hdf5", "fuzz_headers"]

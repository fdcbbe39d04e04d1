"""Files made to do harm: bombs, lies about sizes, pickles, links, names that lead elsewhere.

`HOSTILE[name](folder)` writes one and says how it is read; every one of them must be refused.
"""

from helpers import fuzz_archives, fuzz_bags, fuzz_hdf5, fuzz_headers
from helpers.fuzz_registry import HOSTILE

__all__ = ["HOSTILE", "fuzz_archives", "fuzz_bags", "fuzz_hdf5", "fuzz_headers"]

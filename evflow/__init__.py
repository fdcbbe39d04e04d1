"""evflow: measure an event camera from its recording, and simulate any video as it would see it.

The public names (`__init__.pyi`) load on first use, which keeps `import evflow` and `evflow --help`
fast.
"""

from evflow.process import early

if early.is_command():  # before anything else is loaded
    early.end_on_interrupt()
    early.save_time()

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

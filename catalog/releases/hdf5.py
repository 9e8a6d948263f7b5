"""HDF5 is not safe in several threads: whoever opens, reads or closes a file holds LOCK.

One lock for the process, not for a release: two releases share one HDF5 library.
"""

from __future__ import annotations

import threading

LOCK = threading.RLock()
"""Re-entrant: garbage may be collected, and files closed with it, while it is held."""

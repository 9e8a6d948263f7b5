"""What exists: public sources, products, and releases with the reader an estimator imports."""

from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.releases.reader import Release, open_release

__all__ = ["QualityFlag", "Release", "open_release"]

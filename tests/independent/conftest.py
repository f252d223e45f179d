"""Programs of others read what hyrfpack writes, and hyrfpack reads what they write."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))

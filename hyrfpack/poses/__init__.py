"""Poses from photos: a COLMAP reconstruction by pycolmap, of two mappers' results the one that explains more.

`estimate.py` is the whole of it, in the caller's process; what `worker.py` imports runs in processes of their own.
"""

from hyrfpack.poses.estimate import PosesReport as PosesReport
from hyrfpack.poses.estimate import estimate_poses as estimate_poses

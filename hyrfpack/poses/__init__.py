"""Camera poses from photos: run pycolmap's two mappers and choose the result that explains more matches.

`estimate.py` controls the stages in the caller's process. The modules that `worker.py` imports run in one process for
each stage.
"""

from hyrfpack.poses.estimate import PosesReport as PosesReport
from hyrfpack.poses.estimate import estimate_poses as estimate_poses

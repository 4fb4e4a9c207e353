"""A camera and a printed sheet as the instrument: targets, lens, where camera and sheet are, and one fit of it all."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.camera.arm_poses import NOTHING_KNOWN, ImageMoments
    from modcal_core.camera.bundle import APRIL_GRID, ARUCO_GRID, CHARUCO, CHESSBOARD, MARKER_CORNERS, TAG, BoardView
    from modcal_core.camera.bundle import BundleMarker, MarkerBundle, PrintedTarget
    from modcal_core.camera.changes import CameraCause, CameraWatch, Moved
    from modcal_core.camera.claim import ALL_BUT_IMAGES, APPLY, CANNOT_TELL, ToolError
    from modcal_core.camera.corners import COMMON, MIN_CORNERS, POSE, READOUT, SCALE, SHAPE, SHAPE_NAMES, CameraState
    from modcal_core.camera.corners import CornerTable, corner_rows, enough_corners, grams
    from modcal_core.camera.equations import ReadingsBeside, beside
    from modcal_core.camera.fit import CameraFit, CameraImages, uncertainty_about
    from modcal_core.camera.lens import DISTORTIONS, FISHEYE, PINHOLE, STATED, Lens
    from modcal_core.camera.mounting import MIN_VIEWS, board_poses, first_lens, fit_lens
    from modcal_core.camera.prepared import view_distances
    from modcal_core.camera.solve import CameraProblem, CameraSolution, solve_camera
    from modcal_core.camera.target_file import read_any_target, read_target, target_from_data, target_to_data
    from modcal_core.camera.views import ViewSpread, plan_images
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

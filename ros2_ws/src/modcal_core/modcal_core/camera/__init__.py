"""A camera and a printed sheet as the instrument: targets, lens, where camera and sheet are, and one fit of it all."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.camera.arm_poses import NOTHING_KNOWN, ImageMoments
    from modcal_core.camera.bundle import APRIL_GRID, ARUCO_GRID, CHARUCO, CHESSBOARD, MARKER_CORNERS, TAG, BoardView
    from modcal_core.camera.bundle import BundleMarker, MarkerBundle, PrintedTarget
    from modcal_core.camera.fit import CameraImages
    from modcal_core.camera.changes import CameraCause
    from modcal_core.camera.claim import ALL_BUT_IMAGES, APPLY, CANNOT_TELL, ToolError
    from modcal_core.camera.corners import COMMON, POSE, READOUT, SCALE, SHAPE, SHAPE_NAMES
    from modcal_core.camera.corners import MIN_CORNERS, CameraState, CornerTable, corner_rows, enough_corners, grams
    from modcal_core.camera.fit import CameraFit, uncertainty_about
    from modcal_core.camera.mounting import board_poses, first_lens, fit_lens
    from modcal_core.camera.lens import DISTORTIONS, FISHEYE, PINHOLE, STATED, Lens
    from modcal_core.camera.mounting import MIN_VIEWS
    from modcal_core.camera.equations import ReadingsBeside, beside
    from modcal_core.camera.prepared import view_distances
    from modcal_core.camera.solve import CameraProblem, CameraSolution, solve_camera
    from modcal_core.camera.target_file import read_any_target, read_target, target_from_data, target_to_data
    from modcal_core.camera.views import ViewSpread, plan_images
    from modcal_core.camera.changes import CameraWatch, Moved
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["ALL_BUT_IMAGES", "APPLY", "APRIL_GRID", "ARUCO_GRID", "CANNOT_TELL", "CHARUCO", "CHESSBOARD", "COMMON"]
__all__ += ["DISTORTIONS", "FISHEYE", "MARKER_CORNERS", "MIN_CORNERS", "MIN_VIEWS", "NOTHING_KNOWN", "PINHOLE"]
__all__ += ["POSE", "READOUT", "SCALE", "SHAPE", "SHAPE_NAMES", "STATED", "TAG", "BoardView", "BundleMarker"]
__all__ += ["CameraCause", "CameraFit", "CameraImages", "CameraProblem", "CameraSolution", "CameraState"]
__all__ += ["CameraWatch", "CornerTable", "ImageMoments", "Lens", "MarkerBundle", "Moved"]
__all__ += ["PrintedTarget", "ReadingsBeside", "ToolError", "beside", "board_poses", "corner_rows"]
__all__ += ["enough_corners", "first_lens", "fit_lens", "grams", "plan_images"]
__all__ += ["read_any_target", "read_target", "solve_camera", "target_from_data", "target_to_data"]
__all__ += ["ViewSpread", "uncertainty_about", "view_distances"]

"""Images: finding the printed target in them, reading folders of them, and drawing the sheet to print."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.vision.bag import grey_of, read_bag_images
    from modcal_nodes.vision.coaching import Coach, images_worth, worth_line
    from modcal_nodes.vision.corner_table import camera_key, read_corner_tables
    from modcal_nodes.vision.detection import annotated, board_pose, detect
    from modcal_nodes.vision.images import ImageFolder, joint_column, lens_from_data, read_camera_info, read_images
    from modcal_nodes.vision.images import require_size
    from modcal_nodes.vision.sheet import draw_sheet
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

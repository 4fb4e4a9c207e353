"""Modular arms: a library of modules, which of them are bolted together and how, and the arm that comes of it."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.modules.coding import Coding, assembly_from_data, assembly_to_data, matrix_text
    from modcal_core.modules.errors import ModuleError, ModuleErrors, learn, recording_evidence, store_from_data
    from modcal_core.modules.errors import store_to_data, surprise, twists_from_data, with_recording
    from modcal_core.modules.evaluation import Generation
    from modcal_core.modules.library import JOINT, Assembly, Library, Module, chain_of, library_from_data, module_frames
    from modcal_core.modules.library import published
    from modcal_core.modules.synthesis import Synthesis, SynthesisTask, Watch, described, sentence, synthesize
    from modcal_core.modules.synthesis import task_from_data, to_data, to_markdown
    from modcal_core.modules.urdf import picture, urdf_of
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

"""New plugins, sequences and profiles that run at once, from one set of templates."""

from labseq.scaffolds.making import FILE_KINDS, PLUGINS, CreatedFiles, make_file, make_plugin
from labseq.scaffolds.schemas import SCHEMA_FOLDER, schema_text

__all__ = ["FILE_KINDS", "PLUGINS", "SCHEMA_FOLDER", "CreatedFiles", "make_file", "make_plugin", "schema_text"]

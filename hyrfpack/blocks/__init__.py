"""Train a large scene in blocks: parts of the ground that train one after the other and become one file."""

from hyrfpack.blocks.run import train_blocks

__all__ = ["train_blocks"]

"""What `torchgco new FOLDER` writes: the files of this folder but for this one. Begin with `own.py`."""

"""The rows of a study on the disk.

`identity` tells layouts, solvers and studies apart by digests, `provenance` says where rows come from, `merge` joins
parts of a study, and `folder.StudyFolder` is all that lies in one. Begin with `folder.py`.
"""

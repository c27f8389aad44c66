"""What every part stands on: errors, options, shapes, tensors in trees, random draws, files.

`errors.InputError` is what bad input raises, and `options` checks fields by their types. `tree` takes rows of nested
parts, which is how a batch is cut; `values` are users' numbers per problem, `numbers` those that a compiled problem
may change. It imports nothing of the package. Begin with `tree.py`.
"""

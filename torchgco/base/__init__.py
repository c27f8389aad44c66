"""What every part stands on: errors, options, shapes, tensors in trees, random draws, files."""

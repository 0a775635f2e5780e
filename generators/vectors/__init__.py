"""Test vectors: the shape of their files, and words for their bytes."""

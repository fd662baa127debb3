"""One reader a kind: a rectified patch and the panel file's description in, a `PatchReading` out."""

"""Random worlds by domain: a scene with a camera path through it."""

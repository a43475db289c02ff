"""From shapes and textures to images: ray casting and shading."""

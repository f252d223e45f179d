// Constants that the packing worker and the drawing page share.

export const TEXTURE_WIDTH = 2048; // textures with a texel a splat; every WebGL 2 device supports this width
export const BACKGROUND_RADIUS = 100; // of the background sphere, in a model's local units (docs/reference/format.md 2.7)

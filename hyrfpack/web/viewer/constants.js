// Defines constants that the worker and the page share.

export const TEXTURE_WIDTH = 2048; // for textures with one texel per splat; all WebGL 2 devices support it
export const BACKGROUND_RADIUS = 100; // local units of the model (docs/reference/format.md 2.7)

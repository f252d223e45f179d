// What the worker that packs and the page that draws agree on.

export const TEXTURE_WIDTH = 2048; // of textures with a texel a splat; every WebGL 2 has it
export const SPHERE_RADIUS = 100; // local units of a model: where its background lies (docs/format.md 2.7)

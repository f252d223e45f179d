// Defines constants that the worker and the page share.

import { BACKGROUND_RADIUS } from "../hyrf/fields.js";

export const TEXTURE_WIDTH = 2048; // for textures with one texel per splat; all WebGL 2 devices support it

export { BACKGROUND_RADIUS };

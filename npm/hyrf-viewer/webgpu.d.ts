import type { SceneRenderer } from "./index.js";

/** Draws with WebGPU where it can, and else with WebGL 2: `createViewer({ container, src, renderer: webgpu })`. */
export const webgpu: SceneRenderer;

// The value of the option `renderer` that draws with WebGPU.

import { setShaderSource } from "../../hyrfpack/web/viewer/webgpu/shaders.js";

setShaderSource((name) => WEBGPU_TEXTS[name]); // a constant that tools/browser/build_package.py provides

export { WebgpuRenderer as webgpu } from "../../hyrfpack/web/viewer/webgpu/renderer.js";

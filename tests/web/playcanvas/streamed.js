// Draws the Streamed SOG that the address names: ?index=URL&budget=COUNT&camera=JSON, with a square camera.

import * as pc from "playcanvas";

const given = new URLSearchParams(location.search);
const camera = JSON.parse(given.get("camera"));
const canvas = document.getElementById("canvas");
const options = new pc.AppOptions();
options.graphicsDevice = await pc.createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
options.resourceHandlers = [pc.TextureHandler, pc.GSplatHandler];
const app = new pc.AppBase(canvas);
app.init(options);
app.setCanvasFillMode(pc.FILLMODE_FILL_WINDOW);
app.setCanvasResolution(pc.RESOLUTION_AUTO);
app.scene.gsplat.splatBudget = Number(given.get("budget"));
app.start();

const page = (globalThis.page = { frames: 0, failed: null, drawn: () => app.stats.frame.gsplats });
app.on("update", () => (page.frames += 1));

const asset = new pc.Asset("scene", "gsplat", { url: given.get("index") });
asset.on("error", (error) => (page.failed = String(error)));
asset.on("load", () => {
  const scene = new pc.Entity();
  scene.addComponent("gsplat", { asset });
  app.root.addChild(scene);
});
app.assets.add(asset);
app.assets.load(asset);

// OpenCV's camera looks along z with y down, PlayCanvas' along -z with y up.
const [right, down, forward] = camera.camera_from_world;
const position = [0, 1, 2].map((i) => -(right[i] * right[3] + down[i] * down[3] + forward[i] * forward[3]));
const axes = [right, down.map((value) => -value), forward.map((value) => -value)];
const world = new pc.Mat4();
world.data.set([...axes.flatMap(([x, y, z]) => [x, y, z, 0]), ...position, 1]);
const eye = new pc.Entity();
const fov = (2 * Math.atan(camera.height / 2 / camera.fy) * 180) / Math.PI;
const clearColor = new pc.Color(0, 0, 0);
eye.addComponent("camera", { fov, nearClip: 0.05, farClip: 1e5, clearColor, toneMapping: pc.TONEMAP_NONE });
eye.setPosition(...position);
eye.setRotation(new pc.Quat().setFromMat4(world));
app.root.addChild(eye);

// Uses the viewer's types: npx tsc --noEmit --strict --module nodenext --lib es2022,dom typed.ts

import { createViewer, type Camera, type Viewer } from "hyrf-viewer";
import "hyrf-viewer/element";

const viewer: Viewer = createViewer({ container: document.body, src: new URL("scene.hyrf", document.baseURI) });

const stop: () => void = viewer.on("ready", ({ scene }) => {
  const [first]: Camera[] = scene.cameras;
  if (first) viewer.moveTo(first, { seconds: 2 });
  viewer.camera = 0;
  const camera: Camera | null = viewer.camera;
  console.log(scene.count, camera?.camera_from_world, viewer.cameraText?.length);
});
viewer.on("progress", ({ progress }) => console.log(progress.toFixed(2)));
viewer.on("error", ({ error }) => console.error(error.message));

async function save(): Promise<void> {
  const picture: Blob = await viewer.screenshot({ type: "image/jpeg", quality: 0.9 });
  const point: [number, number, number] | null = viewer.pick(100, 50);
  console.log(picture.size, point?.[2]);
  await viewer.load(picture, { name: "other.spz" });
  stop();
  viewer.destroy();
}

const element = document.querySelector("hyrf-viewer");
element?.addEventListener("click", save);
element?.addEventListener("error", ({ detail }) => console.error(detail.trim()));
element?.addEventListener("camera", ({ detail }) => console.log(detail.camera_from_world));

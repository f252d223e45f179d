// Shows HyrfSplats for tests, among splats of Spark.

import { Color, Quaternion, Vector3 } from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";

import { HyrfSplats, sparkOptions } from "./hyrf-spark.js";
import { page } from "./native.js";

page.Kind = HyrfSplats;
const { load, draw: drawUntilComplete } = page;
page.load = async (file) => {
  await load(file);
  page.scene.add(new SparkRenderer({ renderer: page.renderer, ...sparkOptions(page.object) }));
};

const STILL_FRAMES = 8;

// Draws until the picture stays the same, because Spark sorts in a worker.
page.draw = async () => {
  await drawUntilComplete();
  for (let previous = "", still = 0; still < STILL_FRAMES;) {
    await new Promise((resolve) => setTimeout(resolve, 50));
    page.renderer.render(page.scene, page.camera);
    const picture = page.read();
    still = picture === previous ? still + 1 : 0;
    previous = picture;
  }
};

// Adds one of Spark's own splats, a ball at a place of the file's world, and returns its mesh.
page.addSplat = ([x, y, z], radius, color) => {
  const mesh = new SplatMesh({
    constructSplats: (splats) => splats.pushSplat(
      new Vector3(), new Vector3(radius, radius, radius), new Quaternion(), 1, new Color(...color),
    ),
  });
  mesh.position.copy(page.object.localToWorld(new Vector3(x, y, z)));
  page.scene.add(mesh);
  return mesh;
};

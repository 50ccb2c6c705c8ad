import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { Color, PerspectiveCamera, Scene, SRGBColorSpace, WebGLRenderer } from "three";

import { Stage } from "./stage.js";
import { after } from "./vectors.js";

// Parts of a splat that are under way at once.
const AHEAD = 3;

// Ask for the parts of a splat and put them together; null where another one is wanted meanwhile.
async function fetched(model, scene, progress) {
  const parts = new Array(scene.parts);
  let asked = 0, come = 0;
  return new Promise((resolve) => {
    const ask = () => model.send_msg({ kind: "part", splat: scene.splat, number: asked++ });
    const end = (value) => {
      model.off("msg:custom", hear);
      resolve(value);
    };
    const hear = (message) => {
      if (model.scene.splat !== scene.splat) return end(null);
      if (message.kind !== "part" || message.splat !== scene.splat || parts[message.number]) return;
      parts[message.number] = new Uint8Array(message.data);
      come += 1;
      progress(come / scene.parts);
      if (come < scene.parts) return void (asked < scene.parts && ask());
      const whole = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
      parts.reduce((start, part) => (whole.set(part, start), start + part.length), 0);
      end(whole);
    };
    model.on("msg:custom", hear);
    while (asked < Math.min(AHEAD, scene.parts)) ask();
  });
}

class Painter {
  constructor(model, el) {
    this.model = model;
    const canvas = document.createElement("canvas");
    this.renderer = new WebGLRenderer({ canvas, antialias: false });
    this.renderer.outputColorSpace = SRGBColorSpace;
    this.three = new Scene();
    this.camera = new PerspectiveCamera();
    this.stage = new Stage(el, model, canvas, (...view) => this.paint(...view));
    // As the rasterizers draw (toolkit.splat.rasterize): blurred by 0.3 square pixels without making up for it, drawn
    // down to an alpha of 1/255, sorted by depth.
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      onDirty: () => this.stage.changed(),
      preBlurAmount: 0.3,
      blurAmount: 0,
      maxStdDev: Math.sqrt(2 * Math.log(255)),
      minAlpha: 1 / 255,
      maxPixelRadius: 4096,
      sortRadial: false,
      accumExtSplats: true,
      enableLod: false,
    });
    this.three.add(this.spark);
    canvas.addEventListener("webglcontextlost", () => {
      if (!this.closed) this.fail("The browser gave up drawing with WebGL: reload the page to try again.");
    });
    this.stage.gone.signal.addEventListener("abort", () => this.close());
    model.on("scene", () => this.open());
    this.stage.open();
    this.open();
  }

  fail(text) {
    this.model.failure = text;
  }

  close() {
    this.closed = true;
    this.mesh?.dispose();
    this.spark.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  async open() {
    const scene = this.model.scene;
    if (this.mesh) {
      this.three.remove(this.mesh);
      this.mesh.dispose();
      this.mesh = null;
    }
    this.model.ready = false;
    if (!scene.parts) return this.stage.changed();
    const words = `Loading ${scene.count.toLocaleString("en")} Gaussians (${scene.megabytes} MB)`;
    this.stage.tell(words, 0);
    const bytes = await fetched(this.model, scene, (share) => this.stage.tell(words, share));
    if (!bytes || this.closed) return;
    const mesh = new SplatMesh({ fileBytes: bytes, fileName: "splat.spz", extSplats: true });
    try {
      await mesh.initialized;
    } catch (error) {
      return this.fail(`The splat could not be shown: ${error.message}`);
    }
    if (this.closed || this.model.scene.splat !== scene.splat) return mesh.dispose();
    this.mesh = mesh;
    this.three.add(mesh);
    this.stage.tell();
    this.stage.changed();
    this.model.ready = true;
  }

  paint(navigation, width, height) {
    const { renderer, camera } = this, scale = this.model.scene.scale;
    const dense = Math.min(devicePixelRatio, 2);
    if (renderer.getPixelRatio() !== dense) renderer.setPixelRatio(dense);
    const canvas = renderer.domElement;
    if (canvas.width !== Math.floor(width * dense) || canvas.height !== Math.floor(height * dense)) {
      renderer.setSize(width, height, false);
    }
    const { fx, fy, cx, cy } = navigation.projection(width, height);
    const near = scale * this.model.scene.near, far = 1e6 * near;
    // three.js looks along -z with y up.
    camera.projectionMatrix.set(
      (2 * fx) / width, 0, 1 - (2 * cx) / width, 0,
      0, (2 * fy) / height, (2 * cy) / height - 1, 0,
      0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near),
      0, 0, -1, 0,
    );
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    [camera.near, camera.far] = [near, far];
    camera.position.set(...navigation.position.map((value) => scale * value));
    const [w, x, y, z] = after(navigation.rotation, [0, 1, 0, 0]);
    camera.quaternion.set(x, y, z, w);
    const [red, green, blue] = this.stage.background;
    renderer.setClearColor(new Color().setRGB(red, green, blue, SRGBColorSpace), 1);
    renderer.render(this.three, camera);
  }
}

// Whether the browser draws with WebGL 2. three.js would find out too, but with an error on the console.
function hasWebGL() {
  const context = document.createElement("canvas").getContext("webgl2");
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return context !== null;
}

function render({ model, el }) {
  if (hasWebGL()) new Painter(model, el);
  else model.failure = "This browser does not draw with WebGL 2.";
}

export default { SplatView: { render } };

// Opens what `limpid export` wrote in viewers from npm, in Chromium without a window, and compares what they show from an exported
// camera with Limpid's own picture.
//
//     node view_exports.mjs EXPORT FRAME NODE_MODULES CHROMIUM [PICTURES]
//
// EXPORT holds `--format ply,spz,transforms,glb --at FRAME` and, where the bases allow, `--format glb` as scene.glb. Viewers that are
// not in NODE_MODULES are skipped, and it says so. With PICTURES, screenshots go to that folder. Fails where a viewer shows an error,
// or something else than the picture.

import { spawn } from "node:child_process";
import { createReadStream, existsSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { tmpdir } from "node:os";
import { join, normalize } from "node:path";

const [exported, frame, modules, chromium, pictures] = process.argv.slice(2);
const PATIENCE = 180_000;

// Spark is told to do as Limpid does. The others cannot be told: they cut Gaussians off nearer to their centres, and SuperSplat's
// viewer orders them by distance where Limpid orders by depth.
const MOMENT = `scene_at_${frame}`;
const CASES = [
  { viewer: "spark", name: "@sparkjsdev/spark", file: `${MOMENT}.ply`, least: 30 },
  { viewer: "spark", name: "@sparkjsdev/spark", file: `${MOMENT}.spz`, least: 30 },
  { viewer: "superSplat", name: "@playcanvas/supersplat-viewer", file: `${MOMENT}.ply`, least: 20 },
  { viewer: "three", name: "three", file: `${MOMENT}.ply`, least: 20 },
  { viewer: "three", name: "three", file: `${MOMENT}.spz`, least: 20 },
  { viewer: "three", name: "three", file: `${MOMENT}.glb`, least: 20 },
  { viewer: "playCanvas", name: "playcanvas", file: `${MOMENT}.glb`, least: 20 },
  // three draws each of its parts by itself, and what moves vanishes behind what does not.
  { viewer: "playCanvas", name: "playcanvas", file: "scene.glb", least: 15 },
];

const transforms = JSON.parse(readFileSync(join(exported, "transforms", "transforms.json"), "utf8"));
const view = transforms.frames.filter((entry) => entry.split === "train")[frame];

/** The page, which shows one file in one viewer. Its functions run there. */
function page(asked) {
  const scripts = { "three/addons/": "/modules/three/examples/jsm/", "three/webgpu": "/modules/three/build/three.webgpu.js" };
  scripts["three/tsl"] = "/modules/three/build/three.tsl.js";
  // What draws glTF's Gaussians needs three's newer renderer, and Spark the older one.
  scripts.three = asked.viewer === "three" ? scripts["three/webgpu"] : "/modules/three/build/three.module.js";
  Object.assign(scripts, { playcanvas: "/modules/playcanvas/build/playcanvas.mjs", "playcanvas/": "/modules/playcanvas/" });
  for (const name of ["fflate/esm/browser.js", "@sparkjsdev/spark/dist/spark.module.js"]) {
    scripts[name.replace(/\/(esm|dist)\/.*/, "")] = `/modules/${name}`;
  }
  return `<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<link rel="stylesheet" href="/modules/@playcanvas/supersplat-viewer/dist/viewer.css">
<style>body { margin: 0; overflow: hidden; background: #000 } #at { width: ${view.w}px; height: ${view.h}px }</style><div id="at"></div>
<script type="importmap">${JSON.stringify({ imports: scripts })}</script>
<script type="module">
const file = ${JSON.stringify(asked.file)}, view = ${JSON.stringify(view)}, moment = ${Number(frame)};
const viewers = { spark: ${spark}, three: ${three}, superSplat: ${superSplat}, playCanvas: ${playCanvas} };
${camera}
${likeness}
const frames = (n) => new Promise((done) => requestAnimationFrame(() => done(n > 1 ? frames(n - 1) : undefined)));
const settled = () => frames(10).then(() => new Promise((done) => setTimeout(done, 1000)));
window.likeness = likeness;
window.state = "loading";
viewers.${asked.viewer}("/export/" + file, document.getElementById("at")).then(settled).then(() => (state = "ready"), (error) => (state = String(error.stack)));
</script>`;
}

// three's camera is OpenGL's, as transforms.json has it. glTF and SPZ have y up, and are turned back as docs/EXPORT.md says.
function camera(THREE) {
  const eye = new THREE.PerspectiveCamera((2 * Math.atan(view.h / 2 / view.fl_y) * 180) / Math.PI, view.w / view.h, 0.01, 1000);
  new THREE.Matrix4().set(...view.transform_matrix.flat()).decompose(eye.position, eye.quaternion, eye.scale);
  return eye;
}

async function spark(url, at) {
  const [THREE, { SparkRenderer, SplatMesh }] = await Promise.all([import("three"), import("@sparkjsdev/spark")]);
  const renderer = new THREE.WebGLRenderer({ antialias: false });
  renderer.setSize(view.w, view.h);
  at.append(renderer.domElement);
  const scene = new THREE.Scene();
  scene.add(new SparkRenderer({ renderer, preBlurAmount: 0.3, blurAmount: 0, sortRadial: false, maxStdDev: 3.33, minAlpha: 1 / 255 }));
  const splats = new SplatMesh({ url, extSplats: true });
  if (file.endsWith(".spz")) splats.quaternion.set(1, 0, 0, 0);
  scene.add(splats);
  await splats.initialized;
  const eye = camera(THREE);
  renderer.setAnimationLoop(() => renderer.render(scene, eye));
}

async function three(url, at) {
  const [THREE, { GaussianSplat }] = await Promise.all([import("three"), import("three/addons/objects/GaussianSplat.js")]);
  const renderer = new THREE.WebGPURenderer({ antialias: false, forceWebGL: true });
  await renderer.init();
  renderer.setSize(view.w, view.h);
  // Colours are sRGB already.
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  at.append(renderer.domElement);
  const turned = new THREE.Group();
  if (file.endsWith(".glb")) {
    const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
    const { GLTFGaussianSplatLoaderExtension } = await import("three/addons/loaders/GLTFGaussianSplatLoaderExtension.js");
    const gltf = await new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser)).loadAsync(url);
    turned.add(gltf.scene).quaternion.set(0, 0, 1, 0);
  } else if (file.endsWith(".spz")) {
    const { SPZLoader } = await import("three/addons/loaders/SPZLoader.js");
    turned.add(new GaussianSplat(await new SPZLoader().loadAsync(url))).quaternion.set(1, 0, 0, 0);
  } else {
    const { GaussianSplatPLYLoader } = await import("three/addons/loaders/GaussianSplatPLYLoader.js");
    turned.add(new GaussianSplat(await new GaussianSplatPLYLoader().loadAsync(url)));
  }
  const scene = new THREE.Scene().add(turned);
  const eye = camera(THREE);
  renderer.setAnimationLoop(() => renderer.render(scene, eye));
}

async function playCanvas(url, at) {
  const { AppBase, AppOptions, Asset, Color, Entity, Mat4, Quat, createGraphicsDevice, ...pc } = await import("playcanvas");
  const canvas = document.createElement("canvas");
  at.append(canvas);
  const options = new AppOptions();
  options.graphicsDevice = await createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
  options.graphicsDevice.maxPixelRatio = 1;
  options.componentSystems = [pc.AnimComponentSystem, pc.CameraComponentSystem, pc.GSplatComponentSystem, pc.RenderComponentSystem];
  options.resourceHandlers = [pc.AnimClipHandler, pc.ContainerHandler, pc.GSplatHandler];
  const app = new AppBase(canvas);
  app.init(options);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, view.w, view.h);
  app.start();
  const asset = new Asset("scene", "container", { url });
  await new Promise((done, failed) => {
    asset.once("load", done);
    asset.once("error", (text) => failed(Error(text)));
    app.assets.add(asset);
    app.assets.load(asset);
  });
  const scene = asset.resource.instantiateRenderEntity();
  const turned = new Entity();
  turned.setLocalRotation(0, 0, 1, 0);
  turned.addChild(scene);
  app.root.addChild(turned);
  for (const { resource } of asset.resource.animations) {
    scene.addComponent("anim", { activate: true, speed: 0 });
    scene.anim.assignAnimation("moves", resource);
    // Its key frames are the training frames.
    app.on("update", () => (scene.anim.baseLayer.activeStateCurrentTime = resource.inputs[0].data[moment]));
  }
  const eye = new Entity();
  eye.addComponent("camera", { clearColor: new Color(0, 0, 0), nearClip: 0.01, horizontalFov: false });
  eye.camera.fov = (2 * Math.atan(view.h / 2 / view.fl_y) * 180) / Math.PI;
  const pose = new Mat4().set([0, 1, 2, 3].flatMap((column) => view.transform_matrix.map((row) => row[column])));
  eye.setPosition(pose.getTranslation());
  eye.setRotation(new Quat().setFromMat4(pose));
  app.root.addChild(eye);
}

async function superSplat(contentUrl, container) {
  const { createViewer } = await import("/modules/@playcanvas/supersplat-viewer/dist/viewer.js");
  const { defaultSettings } = await import("/modules/@playcanvas/supersplat-viewer/dist/settings.js");
  const { Mat4, Quat, Vec3 } = await import("playcanvas");
  const viewer = await createViewer({ container, contentUrl, settings: defaultSettings(), renderer: "webgl", ui: false, nofx: true });
  const eye = viewer.app.root.findByName("camera");
  const pose = new Mat4().set([0, 1, 2, 3].flatMap((column) => view.transform_matrix.map((row) => row[column])));
  // The viewer shows PLYs turned by half a turn about z.
  const world = new Mat4().setFromAxisAngle(Vec3.BACK, 180).mul(pose);
  viewer.app.on("prerender", () => {
    eye.setPosition(world.getTranslation());
    eye.setRotation(new Quat().setFromMat4(world));
    eye.camera.horizontalFov = false;
    eye.camera.fov = (2 * Math.atan(view.h / 2 / view.fl_y) * 180) / Math.PI;
  });
  viewer.app.autoRender = true;
  if (!viewer.state.loaded) await new Promise((done) => viewer.events.once("loaded:changed", done));
}

/** How near a screenshot comes to Limpid's picture, in decibels, and on average in steps of 255. */
async function likeness(screenshot) {
  const pixels = async (source) => {
    const picture = new Image();
    picture.src = source;
    await picture.decode();
    const drawn = new OffscreenCanvas(view.w, view.h).getContext("2d");
    drawn.drawImage(picture, 0, 0);
    return drawn.getImageData(0, 0, view.w, view.h).data;
  };
  const [found, own] = [await pixels(screenshot), await pixels("/export/transforms/" + view.file_path)];
  const off = Array.from(found, (value, at) => value - own[at]).filter((_, at) => at % 4 < 3);
  const mean = (of) => off.reduce((sum, value) => sum + of(value), 0) / off.length;
  return [10 * Math.log10(255 ** 2 / Math.max(mean((v) => v * v), 1e-9)), mean(Math.abs)];
}

// Serves the page, the export and the node_modules to this machine.
let asked;
const server = createServer((request, response) => {
  const path = decodeURIComponent(new URL(request.url, "http://localhost").pathname);
  const [, where, inside] = path.match(/^\/(export|modules)\/(.*)$/) ?? [];
  const file = where && normalize(join(where === "export" ? exported : modules, inside));
  if (path === "/") {
    response.setHeader("content-type", "text/html").end(page(asked));
  } else if (file && existsSync(file)) {
    const kinds = { js: "text/javascript", mjs: "text/javascript", css: "text/css", json: "application/json", wasm: "application/wasm" };
    response.setHeader("content-type", kinds[file.split(".").pop()] ?? "application/octet-stream");
    createReadStream(file).pipe(response);
  } else {
    response.writeHead(404).end();
  }
});
await new Promise((done) => server.listen(0, "127.0.0.1", done));
const address = `http://127.0.0.1:${server.address().port}/`;

/** A browser with one page, driven over a pipe: messages are JSON, each ended by a zero byte. */
async function browse(url) {
  const profile = mkdtempSync(join(tmpdir(), "viewer-"));
  const flags = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"];
  flags.push("--no-first-run", "--remote-debugging-pipe", `--user-data-dir=${profile}`, "about:blank");
  const child = spawn(chromium, flags, { stdio: ["ignore", "ignore", "ignore", "pipe", "pipe"] });
  const waiting = new Map();
  const problems = [];
  let [text, last, sessionId] = ["", 0];
  child.stdio[4].on("data", (data) => {
    text += data;
    for (let end = text.indexOf("\0"); end >= 0; end = text.indexOf("\0")) {
      const { id, method, params, result, error } = JSON.parse(text.slice(0, end));
      text = text.slice(end + 1);
      if (id) waiting.get(id)(error ? Promise.reject(Error(JSON.stringify(error))) : result);
      if (method === "Runtime.exceptionThrown") problems.push(JSON.stringify(params.exceptionDetails));
    }
  });
  const send = (method, params = {}) =>
    new Promise((done) => {
      waiting.set(++last, done);
      child.stdio[3].write(JSON.stringify({ id: last, method, params, sessionId }) + "\0");
    });
  const { targetInfos } = await send("Target.getTargets");
  const { targetId } = targetInfos.find((target) => target.type === "page");
  ({ sessionId } = await send("Target.attachToTarget", { targetId, flatten: true }));
  await send("Runtime.enable");
  await send("Page.enable");
  await send("Emulation.setDeviceMetricsOverride", { width: view.w, height: view.h, deviceScaleFactor: 1, mobile: false });
  await send("Page.navigate", { url });
  return {
    problems,
    evaluate: async (expression) => (await send("Runtime.evaluate", { expression, awaitPromise: true, returnByValue: true })).result.value,
    screenshot: async () => (await send("Page.captureScreenshot")).data,
    close: async () => {
      // Of itself it waits for its children, which write to the folder too; killed it does not.
      const exit = new Promise((done) => child.once("exit", done));
      sessionId = undefined;
      send("Browser.close");
      await exit;
      rmSync(profile, { recursive: true, force: true, maxRetries: 20, retryDelay: 100 });
    },
  };
}

for (asked of CASES) {
  const told = join(modules, asked.name, "package.json");
  const needs = asked.viewer === "superSplat" ? ["playcanvas"] : asked.viewer === "spark" ? ["three"] : [];
  const missing = [asked.name, ...needs].find((name) => !existsSync(join(modules, name, "package.json")));
  if (missing || !existsSync(join(exported, asked.file))) {
    console.log(`skipped: ${asked.file} in ${asked.name}: ${missing ? `${missing} is not installed` : "it is not there"}`);
    continue;
  }
  const who = `${asked.name} ${JSON.parse(readFileSync(told, "utf8")).version}`;
  const browser = await browse(address);
  const began = Date.now();
  let state = "loading";
  while (["loading", undefined].includes(state) && Date.now() - began < PATIENCE) {
    await new Promise((done) => setTimeout(done, 200));
    state = await browser.evaluate("window.state");
  }
  const picture = await browser.screenshot();
  if (pictures) writeFileSync(join(pictures, `${asked.viewer}-${asked.file}.png`), Buffer.from(picture, "base64"));
  const [near, mean] = state === "ready" ? await browser.evaluate(`likeness("data:image/png;base64,${picture}")`) : [0, 0];
  await browser.close();
  console.log(`${who}: ${asked.file}: ${state}, ${near.toFixed(1)} dB and ${mean.toFixed(2)}/255 on average from Limpid's own picture`);
  if (state !== "ready" || browser.problems.length || near < asked.least) {
    console.error(browser.problems.join("\n"));
    process.exitCode = 1;
  }
}
server.close();

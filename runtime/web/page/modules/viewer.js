/** The scene in a canvas: Gaussians seen from the first view, turned by pointer and keyboard. */

import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "../lib/spark/spark.module.min.js";
import { OrbitControls } from "../lib/three/controls/OrbitControls.js";
import { invertRigid } from "./linear.js";

const STEP = 0.05; // radians, and share of the distance, of a key
const SWING = 0.2; // radians to each side
const SWING_S = 6;
const MAX_PIXEL_RATIO = 2;
// Drawn after a change, of which the end of a sort in the background is one: so long, and so many frames where each takes
// longer.
const DRAWN_S = 1;
const DRAWN_FRAMES = 3;

/** Shows one scene. `dispose` frees the graphics memory. */
export class Viewer {
  /** @param {HTMLCanvasElement} canvas Throws where the browser has no WebGL 2. */
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, MAX_PIXEL_RATIO));
    this.scene = new THREE.Scene();
    // Sorted by z-depth, as our rasteriser and those that splats are trained with, not by distance.
    const spark = new SparkRenderer({ renderer: this.renderer, sortRadial: false, onDirty: () => this.touch() });
    this.scene.add(spark);
    this.camera = new THREE.PerspectiveCamera(60, 1, 0.01, 1000);
    this.pivot = new THREE.Group();
    this.scene.add(this.pivot);
    this.controls = new OrbitControls(this.camera, canvas);
    this.swinging = false;
    this.touch();
    this.controls.addEventListener("change", () => this.touch());
    this.onKey = (event) => this.key(event);
    canvas.addEventListener("keydown", this.onKey);
    this.resized = new ResizeObserver(() => this.resize());
    this.resized.observe(canvas);
  }

  /** @param {ArrayBuffer} ply @param {import("../idesplat.d.ts").UsedView} view @param {number} distance of the scene */
  async show(ply, view, distance) {
    this.distance = distance;
    this.focal = view.intrinsics.slice(0, 2);
    this.mesh = new SplatMesh({ fileBytes: ply, fileName: "scene.ply" });
    await this.mesh.initialized;
    // From the world to the first camera's frame, its axes turned from OpenCV's to OpenGL's: the scene is upright.
    const pose = new THREE.Matrix4().set(.../** @type {any} */ (invertRigid(view.pose)));
    pose.premultiply(new THREE.Matrix4().makeScale(1, -1, -1));
    pose.premultiply(new THREE.Matrix4().makeTranslation(0, 0, distance));
    pose.decompose(this.mesh.position, this.mesh.quaternion, new THREE.Vector3());
    this.pivot.position.set(0, 0, -distance);
    this.pivot.add(this.mesh);
    this.reset();
    this.resize();
    this.renderer.setAnimationLoop((time) => this.draw(time / 1000));
  }

  /** Draw for a while: a scene that nobody turns costs no power. */
  touch() {
    this.changed = performance.now();
    this.drawn = 0;
  }

  /** Back to the first view. */
  reset() {
    this.touch();
    this.pivot.rotation.set(0, 0, 0);
    this.camera.position.set(0, 0, 0);
    this.camera.near = this.distance / 100;
    this.camera.far = this.distance * 100;
    this.controls.target.copy(this.pivot.position);
    this.controls.update();
    this.swung = 0;
  }

  draw(time) {
    if (this.swinging) {
      const angle = SWING * Math.sin((2 * Math.PI * time) / SWING_S);
      this.pivot.rotation.y += angle - this.swung;
      this.swung = angle;
    }
    this.controls.update();
    const isDrawn = this.drawn >= DRAWN_FRAMES && performance.now() - this.changed > 1000 * DRAWN_S;
    if (isDrawn && !this.swinging) return;
    this.renderer.render(this.scene, this.camera);
    this.drawn += 1;
  }

  key(event) {
    this.touch();
    const turns = { ArrowLeft: ["y", -STEP], ArrowRight: ["y", STEP], ArrowUp: ["x", -STEP], ArrowDown: ["x", STEP] };
    if (event.key in turns) {
      const [axis, angle] = turns[event.key];
      this.pivot.rotation[axis] += angle;
    } else if (event.key === "+" || event.key === "-") {
      const towards = this.controls.target.clone().sub(this.camera.position);
      this.camera.position.addScaledVector(towards, event.key === "+" ? STEP : -STEP);
    } else return;
    event.preventDefault();
  }

  /** The field of view is the first camera's; a wide canvas shows more to the sides. */
  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0 || !this.focal) return;
    this.renderer.setSize(width, height, false);
    this.touch();
    this.camera.aspect = width / height;
    const across = 0.5 / this.focal[0] / this.camera.aspect;
    this.camera.fov = (2 * Math.atan(Math.max(0.5 / this.focal[1], across)) * 180) / Math.PI;
    this.camera.updateProjectionMatrix();
  }

  dispose() {
    this.renderer.setAnimationLoop(null);
    this.resized.disconnect();
    this.canvas.removeEventListener("keydown", this.onKey);
    this.controls.dispose();
    this.mesh?.dispose();
    this.renderer.dispose();
  }
}

/** Images to 3D Gaussians in the browser. The module stands beside the files that `idesplat web` writes. */

export type Provider = "wasm" | "webgpu";

/** stage: what is being done. share: of it that is done, 0 to 1; null where that is not known. */
export interface Progress {
  stage: string;
  share: number | null;
}

export interface Options {
  /** By default WebGPU where it works, else WebAssembly. */
  provider?: Provider | null;
  /** Bounds of depth in the unit of the cameras' positions; found from matched points where not given. */
  near?: number;
  far?: number;
  /** Without cameras: the focal length of images whose EXIF data has none, equivalent to 35 mm film. */
  focal?: number;
  onProgress?: (progress: Progress) => void;
  /** Stops the reconstruction. */
  signal?: AbortSignal;
}

/** In world units and the world frame of the cameras, with OpenCV's axes. */
export interface Gaussians {
  count: number;
  /** Three numbers for each Gaussian. */
  means: Float32Array;
  /** Standard deviations, three numbers for each Gaussian. */
  scales: Float32Array;
  /** w x y z for each Gaussian. */
  quats: Float32Array;
  /** 0 to 1. */
  opacities: Float32Array;
  /** Spherical harmonics in the basis of 3DGS: for each Gaussian its coefficients, for each of these R, G and B. */
  sh: Float32Array;
}

/** Depth along z in world units, view by view, row by row. */
export interface Depth {
  data: Float32Array;
  views: number;
  height: number;
  width: number;
}

/** pose: camera-to-world, OpenCV's axes, 16 numbers row by row. intrinsics: fx fy cx cy over width and height. */
export interface UsedView {
  name: string;
  pose: number[];
  intrinsics: number[];
}

export interface Reconstruction {
  /** A splat file in the layout of 3DGS. */
  ply: Blob;
  depth: Depth;
  gaussians: Gaussians;
  /** The two views that were used. */
  cameras: UsedView[];
  near: number;
  far: number;
  provider: Provider;
  threads: number;
  /** Bytes of WebAssembly's memory at the end, which is its peak. */
  memory: number;
  /** Lines for the user: what was left out, cropped or compensated. */
  notes: string[];
  /** Time by stage: prepare, load, predict. */
  seconds: Record<string, number>;
}

/** An input that cannot be used; its message says what to do. */
export class InputError extends Error {}

/** A pinhole camera with or without lens distortion, as `parseColmap` gives it. */
export interface Camera {
  name: string;
  width: number;
  height: number;
  /** fx fy cx cy in pixels. */
  K: number[];
  /** Camera-to-world, OpenCV's axes, 16 numbers row by row. */
  pose: number[];
  /** OpenCV's k1 k2 p1 p2 k3, or k1 to k4 of a fisheye lens. */
  distortion: number[] | null;
  fisheye: boolean;
}

/** The cameras of COLMAP's text model. Throws `InputError`. */
export function parseColmap(camerasText: string, imagesText: string): Camera[];

/**
 * files: images. cameras: a parsed transforms.json that names them, the result of `parseColmap`, or null to estimate
 * them. Two images are used, those of the best baseline. Rejects with `InputError`.
 */
export function reconstruct(files: Iterable<File>, cameras: unknown, options?: Options): Promise<Reconstruction>;

/** The bytes of a .ply in the layout of 3DGS. */
export function toPly(gaussians: Gaussians): Blob;

/** The bytes of an .spz file, some ten times smaller. */
export function toSpz(gaussians: Gaussians): Promise<Blob>;

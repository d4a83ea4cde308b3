/** Points on the graphics card: a mesh a node, colours by a scale, and shading by depth (eye-dome lighting). */

import {
  BufferAttribute,
  BufferGeometry,
  type Camera,
  ClampToEdgeWrapping,
  DataTexture,
  DepthTexture,
  FloatType,
  GLSL3,
  Group,
  Mesh,
  NearestFilter,
  OrthographicCamera,
  PlaneGeometry,
  Points,
  RGBAFormat,
  Scene,
  ShaderMaterial,
  Vector2,
  WebGLRenderer,
  WebGLRenderTarget,
} from 'three'
import { rgb, scale } from '../core/scales'
import type { CloudNode } from './store'

export const COLOURINGS = ['height', 'intensity', 'class', 'pass', 'rgb'] as const
export type Colouring = (typeof COLOURINGS)[number]

const POINT_VERTEX = /* glsl */ `
in float intensity;
in float class_code;
in float pass;
in float octant;
in vec3 rgb;
uniform int mode;
uniform vec2 range;
uniform float node_height;
uniform float sizes_m[8];
uniform float focal;
uniform vec2 size_px;
uniform sampler2D ramp;
uniform sampler2D codes;
out vec3 colour;
void main() {
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * seen;
  gl_PointSize = clamp(sizes_m[int(octant)] * focal / max(0.01, -seen.z), size_px.x, size_px.y);
  if (mode == 4) { colour = rgb; return; }
  if (mode == 2 || mode == 3) {
    float code = mode == 2 ? class_code : mod(pass, 256.0);
    vec4 found = texture(codes, vec2((code + 0.5) / 256.0, mode == 2 ? 0.25 : 0.75));
    colour = found.rgb;
    if (found.a < 0.5) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    return;
  }
  float value = mode == 0 ? node_height + position.z : intensity;
  float at = clamp((value - range.x) / (range.y - range.x), 0.0, 1.0);
  colour = texture(ramp, vec2((at * 255.0 + 0.5) / 256.0, 0.5)).rgb;
}`

const POINT_FRAGMENT = /* glsl */ `
precision highp float;
in vec3 colour;
out vec4 drawn;
void main() {
  vec2 at = gl_PointCoord - 0.5;
  if (dot(at, at) > 0.25) discard;
  drawn = vec4(colour, 1.0);
}`

const SCREEN_VERTEX = /* glsl */ `
out vec2 at;
void main() { at = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }`

// Boucheny (2009), "Interactive scientific visualization of large datasets", eye-dome lighting: a pixel darkens by how
// much nearer its neighbours are, in the logarithm of the distance.
const SHADING_FRAGMENT = /* glsl */ `
precision highp float;
in vec2 at;
out vec4 drawn;
uniform sampler2D colours;
uniform sampler2D depths;
uniform vec2 pixel;
uniform vec2 planes;
uniform float strength;
uniform vec3 empty;
float distance_log(vec2 where) {
  float depth = texture(depths, where).r;
  if (depth >= 1.0) return -1.0;
  return log2(planes.x * planes.y / (planes.y - depth * (planes.y - planes.x)));
}
void main() {
  float here = distance_log(at);
  vec4 colour = texture(colours, at);
  if (here == -1.0) { drawn = vec4(empty, 1.0); return; }
  float sum = 0.0;
  for (int step = 0; step < 8; step++) {
    float angle = float(step) * 0.785398;
    float there = distance_log(at + pixel * vec2(cos(angle), sin(angle)));
    if (there != -1.0) sum += max(0.0, here - there);
    else sum += 0.02;
  }
  drawn = vec4(colour.rgb * exp(-sum * strength), 1.0);
}`

export interface Look {
  colouring: Colouring
  from: number
  to: number
  ramp: string
  lighting: boolean
  /** Factor of the size of points. */
  size: number
}

export class CloudScene {
  readonly renderer: WebGLRenderer
  readonly #scene = new Scene()
  readonly meshes = new Group()
  readonly #points = new Map<CloudNode, Points<BufferGeometry, ShaderMaterial>>()
  readonly #target: WebGLRenderTarget
  readonly #screen = new Scene()
  readonly #flat = new OrthographicCamera(-1, 1, 1, -1, 0, 1)
  readonly #shading: ShaderMaterial
  readonly #shared = {
    mode: { value: 0 },
    range: { value: new Vector2(0, 1) },
    focal: { value: 1 },
    size_px: { value: new Vector2(1.5, 30) },
    ramp: { value: texture(256, 1) },
    codes: { value: texture(256, 2) },
  }

  constructor(
    canvas: HTMLCanvasElement,
    readonly origin: [number, number, number],
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: false, powerPreference: 'high-performance' })
    this.#target = new WebGLRenderTarget(4, 4, { minFilter: NearestFilter, magFilter: NearestFilter })
    this.#target.depthTexture = new DepthTexture(4, 4, FloatType)
    this.#shading = new ShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: SCREEN_VERTEX,
      fragmentShader: SHADING_FRAGMENT,
      depthTest: false,
      depthWrite: false,
      uniforms: {
        colours: { value: this.#target.texture },
        depths: { value: this.#target.depthTexture },
        pixel: { value: new Vector2() },
        planes: { value: new Vector2() },
        strength: { value: 0 },
        empty: { value: [0, 0, 0] },
      },
    })
    this.#screen.add(new Mesh(new PlaneGeometry(2, 2), this.#shading))
    this.#scene.add(this.meshes)
  }

  /** Colours of classes (first row) and passes (second row); a hidden one is transparent. */
  setCodes(classes: { code: number; colour: string; shown: boolean }[], passes: { code: number; colour: string; shown: boolean }[]): void {
    const data = this.#shared.codes.value.image.data as Uint8Array
    for (let index = 0; index < 512; index++) data.set([158, 158, 158, 255], index * 4)
    for (const [row, list] of [classes, passes].entries()) {
      for (const { code, colour, shown } of list) data.set([...rgb(colour), shown ? 255 : 0], (row * 256 + (code % 256)) * 4)
    }
    this.#shared.codes.value.needsUpdate = true
  }

  setLook({ colouring, from, to, ramp, lighting, size }: Look): void {
    const shared = this.#shared
    shared.mode.value = COLOURINGS.indexOf(colouring)
    const shift = colouring === 'height' ? this.origin[2] : 0
    shared.range.value.set(from - shift, to > from ? to - shift : from - shift + 1e-3)
    const [colours, data] = [scale(ramp), shared.ramp.value.image.data as Uint8Array]
    for (let index = 0; index < 256; index++) data.set([colours[index * 3]!, colours[index * 3 + 1]!, colours[index * 3 + 2]!, 255], index * 4)
    shared.ramp.value.needsUpdate = true
    this.#shading.uniforms['strength']!.value = lighting ? 5 : 0
    shared.size_px.value.set(1.5 * size * this.renderer.getPixelRatio(), 30 * size)
  }

  setEmpty(colour: [number, number, number]): void {
    this.#shading.uniforms['empty']!.value = colour.map((one) => one / 255)
  }

  /** Show these nodes, each with points as large as its spacing, and no others. */
  show(nodes: Map<CloudNode, Float32Array>, size: number): void {
    for (const [node, drawn] of this.#points) drawn.visible = nodes.has(node)
    for (const [node, spacings_m] of nodes) {
      const drawn = this.#points.get(node) ?? this.#add(node)
      drawn.material.uniforms['sizes_m']!.value = spacings_m.map((one) => one * 1.7 * size)
    }
  }

  #add(node: CloudNode): Points<BufferGeometry, ShaderMaterial> {
    const points = node.points!
    const geometry = new BufferGeometry()
    geometry.setAttribute('position', new BufferAttribute(points.position, 3))
    geometry.setAttribute('intensity', new BufferAttribute(points.intensity, 1))
    geometry.setAttribute('class_code', new BufferAttribute(points.classes, 1))
    geometry.setAttribute('pass', new BufferAttribute(points.pass, 1))
    geometry.setAttribute('octant', new BufferAttribute(points.octant, 1))
    if (points.rgb) geometry.setAttribute('rgb', new BufferAttribute(points.rgb, 3, true))
    const material = new ShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: POINT_VERTEX,
      fragmentShader: POINT_FRAGMENT,
      uniforms: { ...this.#shared, sizes_m: { value: new Float32Array(8) }, node_height: { value: node.origin[2] - this.origin[2] } },
    })
    const drawn = new Points(geometry, material)
    drawn.position.set(node.origin[0] - this.origin[0], node.origin[1] - this.origin[1], node.origin[2] - this.origin[2])
    drawn.updateMatrixWorld()
    drawn.matrixAutoUpdate = false
    drawn.frustumCulled = false
    this.#points.set(node, drawn)
    this.#scene.add(drawn)
    return drawn
  }

  drop(node: CloudNode): void {
    const drawn = this.#points.get(node)
    if (!drawn) return
    this.#scene.remove(drawn)
    drawn.geometry.dispose()
    drawn.material.dispose()
    this.#points.delete(node)
  }

  resize(width: number, height: number): void {
    const ratio = Math.min(2, window.devicePixelRatio || 1)
    this.renderer.setPixelRatio(ratio)
    this.renderer.setSize(width, height, false)
    this.#target.setSize(Math.max(1, Math.floor(width * ratio)), Math.max(1, Math.floor(height * ratio)))
  }

  render(camera: Camera & { near: number; far: number }, focal: number): void {
    const ratio = this.renderer.getPixelRatio()
    this.#shared.focal.value = focal * ratio
    const { uniforms } = this.#shading
    uniforms['pixel']!.value.set((1.4 * ratio) / this.#target.width, (1.4 * ratio) / this.#target.height)
    uniforms['planes']!.value.set(camera.near, camera.far)
    this.renderer.setRenderTarget(this.#target)
    this.renderer.render(this.#scene, camera)
    this.renderer.setRenderTarget(null)
    this.renderer.render(this.#screen, this.#flat)
  }
}

function texture(width: number, height: number): DataTexture {
  const made = new DataTexture(new Uint8Array(width * height * 4).fill(255), width, height, RGBAFormat)
  made.minFilter = made.magFilter = NearestFilter
  made.wrapS = made.wrapT = ClampToEdgeWrapping
  return made
}

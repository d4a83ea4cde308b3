/** Meshes of the detailed surface, tile by tile, around the place that the eye looks at. */

import { BufferGeometry, DoubleSide, GLSL3, type Group, type Material, Mesh, ShaderMaterial } from 'three'
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js'
import type { MeshIndex } from '../core/site'
import type { Source } from '../core/source'

const REACH_M = 60
const MOST = 48

const VERTEX = /* glsl */ `
in vec4 color;
out vec3 tint;
out vec3 place;
void main() {
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  tint = color.rgb;
  place = seen.xyz;
  gl_Position = projectionMatrix * seen;
}`

// Light from the eye's left and above: the slope of a face is read off its derivatives.
const FRAGMENT = /* glsl */ `
precision highp float;
in vec3 tint;
in vec3 place;
out vec4 drawn;
void main() {
  vec3 across = normalize(cross(dFdx(place), dFdy(place)));
  float light = 0.45 + 0.55 * abs(dot(across, normalize(vec3(-0.4, 0.6, 0.7))));
  drawn = vec4(pow(tint, vec3(1.0 / 2.2)) * light, 1.0);
}`

export class SurfaceMeshes {
  shown = false
  readonly #loader = new GLTFLoader()
  readonly #held = new Map<string, Promise<Mesh[]>>()
  readonly #material: Material = new ShaderMaterial({ glslVersion: GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, side: DoubleSide })

  constructor(
    readonly index: MeshIndex,
    readonly source: Source,
    readonly group: Group,
    readonly origin: readonly [number, number, number],
    readonly arrived: () => void,
    readonly complain: (error: unknown) => void,
  ) {}

  /** Show the meshes around a place of the map. */
  look(easting_m: number, northing_m: number): void {
    this.group.visible = this.shown
    if (!this.shown) return
    const apart = ([e0, n0, e1, n1]: readonly number[]): number => Math.hypot(Math.max(e0! - easting_m, 0, easting_m - e1!), Math.max(n0! - northing_m, 0, northing_m - n1!))
    const near = this.index.meshes.filter((one) => apart(one.bounds_m) < REACH_M).sort((a, b) => apart(a.bounds_m) - apart(b.bounds_m)).slice(0, MOST)
    const wanted = new Set(near.map((one) => one.url))
    for (const [url, loading] of this.#held) if (!wanted.has(url)) this.#drop(url, loading)
    for (const one of near) if (!this.#held.has(one.url)) this.#held.set(one.url, this.#load(one))
  }

  async #load({ url, origin_m }: MeshIndex['meshes'][number]): Promise<Mesh[]> {
    try {
      const bytes = await this.source.bytes(url)
      const { scene } = await this.#loader.parseAsync(bytes.slice().buffer, '')
      scene.updateMatrixWorld(true)
      const made: Mesh[] = []
      scene.traverse((one) => {
        if (one instanceof Mesh && one.geometry instanceof BufferGeometry) made.push(this.#placed(one, origin_m))
      })
      if (this.#held.has(url)) for (const mesh of made) this.group.add(mesh)
      this.arrived()
      return made
    } catch (error) {
      this.complain(error)
      return []
    }
  }

  /** glTF's y is up: east is x, north is -z. */
  #placed(one: Mesh, origin_m: readonly [number, number, number]): Mesh {
    const mesh = new Mesh(one.geometry.clone().applyMatrix4(one.matrixWorld), this.#material)
    mesh.rotation.x = Math.PI / 2
    mesh.position.set(origin_m[0] - this.origin[0], origin_m[1] - this.origin[1], origin_m[2] - this.origin[2])
    mesh.updateMatrixWorld(true)

    return mesh
  }

  #drop(url: string, loading: Promise<Mesh[]>): void {
    this.#held.delete(url)
    void loading.then((meshes) => {
      for (const mesh of meshes) {
        this.group.remove(mesh)
        mesh.geometry.dispose()
      }
    })
  }
}

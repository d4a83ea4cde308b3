/** From a place to a pixel and back. Pixels count from the centre of the upper left one; camera axes are OpenCV's. */

import type { Camera } from '../core/site'

export interface Pose {
  easting_m: number
  northing_m: number
  height_m: number
  /** Rotation (and the map's scale) from map axes to camera axes, row by row. */
  camera_from_map: readonly number[]
}

type Vector = [number, number, number]

/** The pixel at which a place is seen, and its distance (m); null where it is behind the camera or outside the picture. */
export function pixelOf(camera: Camera, pose: Pose, place: Readonly<Vector>): { u: number; v: number; distance_m: number } | null {
  const by = [place[0] - pose.easting_m, place[1] - pose.northing_m, place[2] - pose.height_m] as const
  const r = pose.camera_from_map
  const d = [0, 3, 6].map((row) => r[row]! * by[0] + r[row + 1]! * by[1] + r[row + 2]! * by[2]) as Vector
  const distance_m = Math.hypot(...d)
  const pixel = camera.model === 'equirectangular' ? around(camera, d) : ahead(camera, d)
  if (!pixel) return null
  const [u, v] = pixel
  if (u < -0.5 || v < -0.5 || u > camera.width_px - 0.5 || v > camera.height_px - 0.5) return null
  return { u, v, distance_m }
}

function around(camera: Camera, d: Vector): [number, number] | null {
  const level = Math.hypot(d[0], d[2])
  return level || d[1] ? pixelAtAngles(camera, Math.atan2(d[0], d[2]), Math.atan2(d[1], level)) : null
}

/** The pixel of an equirectangular picture at a longitude and a latitude (radians, right and down of ahead). */
export function pixelAtAngles({ focal_px, principal_px }: Camera, longitude: number, latitude: number): [number, number] {
  return [principal_px[0] + focal_px[0] * longitude, principal_px[1] + focal_px[1] * latitude]
}

/** Longitude and latitude that a pixel of an equirectangular picture looks to. */
export function anglesOf({ focal_px, principal_px }: Camera, u: number, v: number): [number, number] {
  return [(u - principal_px[0]) / focal_px[0], (v - principal_px[1]) / focal_px[1]]
}

function ahead(camera: Camera, d: Vector): [number, number] | null {
  if (d[2] <= 1e-6) return null
  const [a, b] = [d[0] / d[2], d[1] / d[2]]
  // Beyond the angle of the lens, the polynomial of the distortion folds back: such a place is not seen.
  const widest = (Math.hypot(camera.width_px, camera.height_px) / Math.min(...camera.focal_px)) * 0.9
  if (Math.hypot(a, b) > widest) return null
  const [x, y] = distort(camera, a, b)
  return [camera.principal_px[0] + camera.focal_px[0] * x, camera.principal_px[1] + camera.focal_px[1] * y]
}

/** Brown's distortion of a point of the plane at distance 1 (Brown 1971; OpenCV's order k1, k2, p1, p2, k3). */
function distort(camera: Camera, a: number, b: number): [number, number] {
  const [k1, k2, p1, p2, k3] = camera.distortion ?? [0, 0, 0, 0, 0]
  const r2 = a * a + b * b
  const radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
  return [a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a), b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b]
}

/** The direction, of length 1 in map axes, in which a pixel looks. */
export function rayOf(camera: Camera, pose: Pose, u: number, v: number): Vector {
  const d = camera.model === 'equirectangular' ? aroundRay(camera, u, v) : aheadRay(camera, u, v)
  const map = solve(pose.camera_from_map, d)
  const size = Math.hypot(...map)
  return map.map((one) => one / size) as Vector
}

/** x of M · x = d by Cramer's rule: the matrix holds the map's scale, so its transpose is not its inverse. */
function solve(m: readonly number[], d: Vector): Vector {
  const det = (a: Vector, b: Vector, c: Vector): number => a[0] * (b[1] * c[2] - b[2] * c[1]) - b[0] * (a[1] * c[2] - a[2] * c[1]) + c[0] * (a[1] * b[2] - a[2] * b[1])
  const [a, b, c] = [0, 1, 2].map((column) => [m[column]!, m[column + 3]!, m[column + 6]!] as Vector) as [Vector, Vector, Vector]
  const whole = det(a, b, c)
  return [det(d, b, c) / whole, det(a, d, c) / whole, det(a, b, d) / whole]
}

function aroundRay(camera: Camera, u: number, v: number): Vector {
  const [longitude, latitude] = anglesOf(camera, u, v)
  return [Math.sin(longitude) * Math.cos(latitude), Math.sin(latitude), Math.cos(longitude) * Math.cos(latitude)]
}

/** Newton's method on the distortion, with its derivatives by differences: six steps leave less than 1e-9. */
function aheadRay(camera: Camera, u: number, v: number): Vector {
  const [x, y] = [(u - camera.principal_px[0]) / camera.focal_px[0], (v - camera.principal_px[1]) / camera.focal_px[1]]
  let [a, b] = [x, y]
  const step = 1e-6
  for (let turn = 0; turn < 8; turn++) {
    const [fx, fy] = distort(camera, a, b)
    const [ax, ay] = distort(camera, a + step, b)
    const [bx, by] = distort(camera, a, b + step)
    const [xa, ya, xb, yb] = [(ax - fx) / step, (ay - fy) / step, (bx - fx) / step, (by - fy) / step]
    const size = xa * yb - xb * ya
    if (Math.abs(size) < 1e-9) break
    a -= ((fx - x) * yb - (fy - y) * xb) / size
    b -= ((fy - y) * xa - (fx - x) * ya) / size
  }
  return [a, b, 1]
}

/** Metres on a surface that faces the camera which a pixel covers at a distance. */
export function pixelSize(camera: Camera, distance_m: number): number {
  return distance_m / camera.focal_px[0]
}

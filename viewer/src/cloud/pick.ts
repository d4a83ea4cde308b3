/** Finds the point below a pixel, and the point that a ray meets first. */

import type { Camera, Matrix4 } from 'three'
import type { Box, CloudNode, CloudStore } from './store'

export interface Picked {
  node: CloudNode
  index: number
  coordinate: [number, number, number]
}

export type Shown = (node: CloudNode, index: number) => boolean

/** The point of the foremost surface that lies nearest to a pixel, among those within some pixels of it. */
export function pick(
  store: CloudStore,
  nodes: Iterable<CloudNode>,
  camera: Camera,
  origin: readonly number[],
  screen: { width: number; height: number; x: number; y: number },
  reach_px: number,
  shown: Shown,
): Picked | null {
  const seen = camera.matrixWorldInverse.clone().premultiply(camera.projectionMatrix)
  const found: { node: CloudNode; index: number; depth: number; apart: number }[] = []
  let front = Infinity
  for (const node of nodes) {
    if (!node.points || !mayHold(node.box, seen, origin, screen, reach_px)) continue
    const m = seen.elements
    const [ox, oy, oz] = [node.origin[0] - origin[0]!, node.origin[1] - origin[1]!, node.origin[2] - origin[2]!]
    const { position, count } = node.points
    for (let index = 0, at = 0; index < count; index++, at += 3) {
      const [x, y, z] = [position[at]! + ox, position[at + 1]! + oy, position[at + 2]! + oz]
      const w = m[3]! * x + m[7]! * y + m[11]! * z + m[15]!
      if (w <= 0) continue
      const dx = ((m[0]! * x + m[4]! * y + m[8]! * z + m[12]!) / w / 2 + 0.5) * screen.width - screen.x
      if (dx > reach_px || dx < -reach_px) continue
      const dy = (0.5 - (m[1]! * x + m[5]! * y + m[9]! * z + m[13]!) / w / 2) * screen.height - screen.y
      const apart = dx * dx + dy * dy
      if (apart > reach_px * reach_px || !shown(node, index)) continue
      found.push({ node, index, depth: w, apart })
      if (w < front) front = w
    }
  }
  let best: (typeof found)[number] | null = null
  for (const one of found) if (one.depth <= front * 1.02 + 0.05 && (!best || one.apart < best.apart)) best = one
  return best && { node: best.node, index: best.index, coordinate: store.coordinate(best.node, best.index) }
}

/** False where a node's box lies beside the pixel. */
function mayHold(box: Box, seen: Matrix4, origin: readonly number[], screen: { width: number; height: number; x: number; y: number }, reach_px: number): boolean {
  const m = seen.elements
  let [left, right, top, bottom] = [Infinity, -Infinity, Infinity, -Infinity]
  for (let corner = 0; corner < 8; corner++) {
    const [x, y, z] = [0, 1, 2].map((axis) => (corner & (1 << axis) ? box.max[axis]! : box.min[axis]!) - origin[axis]!) as [number, number, number]
    const w = m[3]! * x + m[7]! * y + m[11]! * z + m[15]!
    if (w <= 0.01) return true
    const sx = ((m[0]! * x + m[4]! * y + m[8]! * z + m[12]!) / w / 2 + 0.5) * screen.width
    const sy = (0.5 - (m[1]! * x + m[5]! * y + m[9]! * z + m[13]!) / w / 2) * screen.height
    ;[left, right, top, bottom] = [Math.min(left, sx), Math.max(right, sx), Math.min(top, sy), Math.max(bottom, sy)]
  }
  return screen.x >= left - reach_px && screen.x <= right + reach_px && screen.y >= top - reach_px && screen.y <= bottom + reach_px
}

export interface Ray {
  from: readonly [number, number, number]
  /** Of length 1. */
  direction: readonly [number, number, number]
}

/**
 * The point that a ray meets first: within a cone of an angle (radian) about it, the foremost cluster, and in that the
 * point nearest to the ray. `least_m` and `most_m` bound the distance from its beginning.
 */
export function meet(store: CloudStore, nodes: Iterable<CloudNode>, ray: Ray, cone: number, least_m: number, most_m: number): (Picked & { distance_m: number; apart_m: number }) | null {
  const [dx, dy, dz] = ray.direction
  const found: { node: CloudNode; index: number; distance: number; apart: number }[] = []
  for (const node of nodes) {
    if (!node.points || !rayNear(node.box, ray, cone, most_m)) continue
    const { position, count } = node.points
    const [ox, oy, oz] = [node.origin[0] - ray.from[0], node.origin[1] - ray.from[1], node.origin[2] - ray.from[2]]
    for (let index = 0, at = 0; index < count; index++, at += 3) {
      const [x, y, z] = [position[at]! + ox, position[at + 1]! + oy, position[at + 2]! + oz]
      const distance = x * dx + y * dy + z * dz
      if (distance < least_m || distance > most_m) continue
      const apart2 = x * x + y * y + z * z - distance * distance
      const reach = Math.max(0.01, cone * distance)
      if (apart2 < reach * reach) found.push({ node, index, distance, apart: Math.sqrt(Math.max(0, apart2)) })
    }
  }
  if (!found.length) return null
  // The foremost cluster: at a flat angle a surface is met over a length, so the nearest to the ray within it counts.
  found.sort((a, b) => a.distance - b.distance)
  const front = found[0]!.distance
  let best = found[0]!
  for (const one of found) {
    if (one.distance > front * 1.15 + 0.3) break
    if (one.apart < best.apart) best = one
  }
  return { node: best.node, index: best.index, coordinate: store.coordinate(best.node, best.index), distance_m: best.distance, apart_m: best.apart }
}

/** True where a node's ball meets the cone of a ray. */
export function rayNear(box: Box, { from, direction }: Ray, cone: number, most_m: number): boolean {
  const middle = [0, 1, 2].map((axis) => (box.min[axis]! + box.max[axis]!) / 2 - from[axis]!) as [number, number, number]
  const radius = Math.hypot(box.max[0] - box.min[0], box.max[1] - box.min[1], box.max[2] - box.min[2]) / 2
  const along = middle[0] * direction[0] + middle[1] * direction[1] + middle[2] * direction[2]
  if (along < -radius || along > most_m + radius) return false
  const apart = Math.sqrt(Math.max(0, middle[0] ** 2 + middle[1] ** 2 + middle[2] ** 2 - along * along))
  return apart <= radius + cone * Math.max(0, along) + 0.02
}

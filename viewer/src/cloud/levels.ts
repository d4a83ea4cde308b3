/** Which nodes are drawn: coarse ones first, finer ones where they are near, as many points as a budget allows. */

import { Box3, type Camera, Frustum, Matrix4, Vector3 } from 'three'
import type { Box, CloudNode, CloudStore } from './store'

/** Points closer together than so many pixels need no finer level. */
const ENOUGH_PX = 1.3

export interface Chosen {
  /** Nodes to draw; for each of the eight parts of a node, the distance of points that is reached there (m). */
  nodes: Map<CloudNode, Float32Array>
  points: number
}

export function chooseNodes(store: CloudStore, camera: Camera, eye: Vector3, focal_px: number, origin: readonly number[], budget: number): Chosen {
  const frustum = new Frustum().setFromProjectionMatrix(new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse))
  const local = ({ min, max }: Box): Box3 =>
    new Box3(new Vector3(min[0] - origin[0]!, min[1] - origin[1]!, min[2] - origin[2]!), new Vector3(max[0] - origin[0]!, max[1] - origin[1]!, max[2] - origin[2]!))
  const waiting: { node: CloudNode; weight: number }[] = []
  const add = (node: CloudNode): void => {
    const box = local(node.box)
    if (!frustum.intersectsBox(box)) return
    const distance = Math.max(0.5, box.distanceToPoint(eye))
    const radius = box.getSize(new Vector3()).length() / 2
    waiting.push({ node, weight: (radius * focal_px) / distance })
  }
  for (const sheet of store.sheets) {
    const box = local(sheet.bounds)
    if (!frustum.intersectsBox(box)) continue
    const size_px = (box.getSize(new Vector3()).length() * focal_px) / Math.max(1, box.distanceToPoint(eye))
    if (size_px < 40) continue
    const root = sheet.nodes.get('0-0-0-0')
    if (root) add(root)
    else if (!sheet.copc) void store.open(sheet)
  }
  // Finer nodes are asked for together with coarser ones, which come first: the file says where all of them lie.
  const nodes = new Map<CloudNode, Float32Array>()
  let points = 0
  while (waiting.length) {
    let best = 0
    for (let index = 1; index < waiting.length; index++) if (waiting[index]!.weight > waiting[best]!.weight) best = index
    const { node } = waiting[best]!
    waiting[best] = waiting.at(-1)!
    waiting.pop()
    if (points + node.count > budget) break
    points += node.count
    node.used = store.turn
    if (node.points) nodes.set(node, new Float32Array(8).fill(node.spacing_m))
    else if (node.count) void store.load(node)
    const distance = Math.max(0.5, local(node.box).distanceToPoint(eye))
    if ((node.spacing_m * focal_px) / distance > ENOUGH_PX) for (const child of store.children(node)) add(child)
  }
  reached(store, nodes)
  return { nodes, points }
}

/** Where a child is drawn, its parent's points are as dense as the densest of it: what is coarser there, the child draws. */
function reached(store: CloudStore, nodes: Map<CloudNode, Float32Array>): void {
  for (const node of [...nodes.keys()].sort((a, b) => b.depth - a.depth)) {
    for (const child of store.children(node)) {
      const below = nodes.get(child)
      if (below) nodes.get(node)![octantOf(child)] = Math.min(...below)
    }
  }
}

function octantOf(child: CloudNode): number {
  const [, x, y, z] = child.key.split('-').map(Number) as [number, number, number, number]
  return (x & 1) | ((y & 1) << 1) | ((z & 1) << 2)
}

/** Heights of the ground among points: the lowest of each square metre, without the tails. */

import type { CloudNode } from './store'

/** A square holds the ground where most of its points do not stand on anything. */
const SQUARE_M = 1
/** Percentiles of the squares: lone points below the road and squares under houses lie outside. */
const [LOW, HIGH] = [0.02, 0.98]
/** A level road is not spread over its noise. */
const LEAST_M = 0.2

/** Least and greatest height (m); null where there are too few points. */
export function groundHeights(nodes: readonly CloudNode[]): [number, number] | null {
  const lowest = new Map<string, number>()
  for (const { points, origin } of nodes) {
    if (!points) continue
    const { position, count } = points
    for (let index = 0, at = 0; index < count; index++, at += 3) {
      const square = `${Math.floor((position[at]! + origin[0]) / SQUARE_M)} ${Math.floor((position[at + 1]! + origin[1]) / SQUARE_M)}`
      const height = position[at + 2]! + origin[2]
      const known = lowest.get(square)
      if (known === undefined || height < known) lowest.set(square, height)
    }
  }
  if (lowest.size < 10) return null
  const heights = [...lowest.values()].sort((a, b) => a - b)
  const [from, to] = [heights[Math.floor((heights.length - 1) * LOW)]!, heights[Math.ceil((heights.length - 1) * HIGH)]!]
  const room = Math.max(0, LEAST_M - (to - from)) / 2
  return [from - room, to + room]
}

/** Points within a strip along a line: cross-sections and profiles, in full precision. */

import type { Box, CloudNode, CloudStore } from './store'

export type Line = readonly (readonly [number, number])[]

const MOST_POINTS = 8_000_000

export interface SliceBin {
  /** Middle of the bin along the line (m), median height (m), 1 σ of the median (m), points. */
  station_m: number
  height_m: number
  sigma_m: number
  count: number
}

export interface Slice {
  line: Line
  length_m: number
  half_width_m: number
  /** Of each point: metres along the line, height (m), pass, class. Sorted by the first. */
  station_m: Float64Array
  height_m: Float64Array
  pass: Uint16Array
  classes: Uint8Array
  bins: SliceBin[]
  /** False where the cloud holds more points here than can be shown. */
  whole: boolean
}

/** Points nearer to a line than half a width (m), and their medians in bins of a width (m). */
export async function sliceAlong(store: CloudStore, line: Line, half_width_m: number, bin_m: number): Promise<Slice> {
  const { nodes, whole } = await store.within((box) => near(box, line, half_width_m), MOST_POINTS)
  const found: { station: number; height: number; pass: number; code: number }[] = []
  for (const node of nodes) collect(node, line, half_width_m, found)
  found.sort((a, b) => a.station - b.station || a.height - b.height)
  const slice: Slice = {
    line,
    length_m: lengths(line).at(-1)!,
    half_width_m,
    station_m: Float64Array.from(found, (one) => one.station),
    height_m: Float64Array.from(found, (one) => one.height),
    pass: Uint16Array.from(found, (one) => one.pass),
    classes: Uint8Array.from(found, (one) => one.code),
    bins: [],
    whole,
  }
  slice.bins = binned(slice.station_m, slice.height_m, bin_m)
  return slice
}

/** Metres along a line at each of its corners. */
export function lengths(line: Line): number[] {
  const sums = [0]
  for (let index = 1; index < line.length; index++) {
    sums.push(sums[index - 1]! + Math.hypot(line[index]![0] - line[index - 1]![0], line[index]![1] - line[index - 1]![1]))
  }
  return sums
}

/** The place at a distance along a line. */
export function along(line: Line, station_m: number): [number, number] {
  const sums = lengths(line)
  let index = 1
  while (index < line.length - 1 && sums[index]! < station_m) index++
  const [a, b] = [line[index - 1]!, line[index]!]
  const part = (station_m - sums[index - 1]!) / (sums[index]! - sums[index - 1]! || 1)
  return [a[0] + (b[0] - a[0]) * part, a[1] + (b[1] - a[1]) * part]
}

function near(box: Box, line: Line, half_width_m: number): boolean {
  const middle = [(box.min[0] + box.max[0]) / 2, (box.min[1] + box.max[1]) / 2] as const
  const reach = Math.hypot(box.max[0] - box.min[0], box.max[1] - box.min[1]) / 2 + half_width_m
  for (let index = 1; index < line.length; index++) {
    const [a, b] = [line[index - 1]!, line[index]!]
    const [dx, dy] = [b[0] - a[0], b[1] - a[1]]
    const part = Math.max(0, Math.min(1, ((middle[0] - a[0]) * dx + (middle[1] - a[1]) * dy) / (dx * dx + dy * dy || 1)))
    if (Math.hypot(middle[0] - a[0] - part * dx, middle[1] - a[1] - part * dy) <= reach) return true
  }
  return false
}

function collect(node: CloudNode, line: Line, half: number, into: { station: number; height: number; pass: number; code: number }[]): void {
  const points = node.points!
  const sums = lengths(line)
  const { scale, offset } = node.sheet
  for (let segment = 1; segment < line.length; segment++) {
    const [a, b] = [line[segment - 1]!, line[segment]!]
    const size = sums[segment]! - sums[segment - 1]!
    if (!size) continue
    const [ux, uy] = [(b[0] - a[0]) / size, (b[1] - a[1]) / size]
    const [dx, dy] = [offset[0] - a[0], offset[1] - a[1]]
    for (let index = 0; index < points.count; index++) {
      const x = points.raw[index * 3]! * scale[0] + dx
      const y = points.raw[index * 3 + 1]! * scale[1] + dy
      if (Math.abs(x * uy - y * ux) > half) continue
      const station = x * ux + y * uy
      if (station < 0 || station > size) continue
      into.push({
        station: sums[segment - 1]! + station,
        height: points.raw[index * 3 + 2]! * scale[2] + offset[2],
        pass: points.pass[index]!,
        code: points.classes[index]!,
      })
    }
  }
}

function binned(station: Float64Array, height: Float64Array, bin_m: number): SliceBin[] {
  const bins: SliceBin[] = []
  let first = 0
  while (first < station.length) {
    const bin = Math.floor(station[first]! / bin_m)
    let last = first
    while (last < station.length && Math.floor(station[last]! / bin_m) === bin) last++
    const heights = height.slice(first, last).sort()
    const middle = median(heights)
    const spread = 1.4826 * median(heights.map((one) => Math.abs(one - middle)).sort())
    bins.push({ station_m: (bin + 0.5) * bin_m, height_m: middle, sigma_m: (1.2533 * spread) / Math.sqrt(heights.length), count: heights.length })
    first = last
  }
  return bins
}

function median(sorted: Float64Array): number {
  const half = sorted.length >> 1
  return sorted.length % 2 ? sorted[half]! : (sorted[half - 1]! + sorted[half]!) / 2
}

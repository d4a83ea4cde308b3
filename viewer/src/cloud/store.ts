/** The survey's cloud: sheets in COPC, whose nodes are fetched by ranges and kept as long as they fit. */

import { Copc, type Hierarchy } from 'copc'
import type { CloudIndex, Survey } from '../core/site'
import type { Source } from '../core/source'
import type { Decoded } from './decode.worker'
import { Decoders } from './decoders'

const KEPT_POINTS = 12_000_000
const AT_ONCE = 6
/** Clouds of more sheets are opened as they come into sight. */
const MOST_AT_FIRST = 12

export interface Box {
  /** Least and greatest easting, northing, height (m). */
  min: [number, number, number]
  max: [number, number, number]
}

export interface CloudNode {
  readonly key: string
  readonly sheet: Sheet
  readonly depth: number
  readonly box: Box
  /** Distance of its points (m), as the file states it. */
  readonly spacing_m: number
  readonly count: number
  readonly origin: [number, number, number]
  /** Middle of its cube, which the box is a part of. */
  readonly middle: [number, number, number]
  points: Decoded | null
  loading: Promise<void> | null
  failed: boolean
  /** Turn in which it was last asked for. */
  used: number
}

export interface Sheet {
  readonly name: string
  readonly url: string
  readonly bounds: Box
  readonly points: number
  open: Promise<void> | null
  copc: Copc | null
  /** Metres of the map: number · scale + offset. */
  scale: [number, number, number]
  offset: [number, number, number]
  readonly nodes: Map<string, CloudNode>
  /** Pages of the hierarchy that have not been asked for, and those that are on their way or here. */
  readonly pages: Map<string, Hierarchy.Page>
  readonly asked: Map<string, Promise<void>>
}

export const centre = ({ min, max }: Box): [number, number, number] => [(min[0] + max[0]) / 2, (min[1] + max[1]) / 2, (min[2] + max[2]) / 2]

export const boxesMeet = (a: Box, b: Box): boolean => [0, 1, 2].every((axis) => a.min[axis]! <= b.max[axis]! && b.min[axis]! <= a.max[axis]!)

export class CloudStore {
  readonly sheets: Sheet[]
  /** Called whenever something arrived. */
  arrived: () => void = () => {}
  turn = 0
  /** True where the points have colours, as far as it is known yet. */
  coloured = false
  readonly #decoders = new Decoders()
  readonly #queue: { node: CloudNode; needed: boolean; start: () => void }[] = []
  #running = 0
  /** Pages of the hierarchy that are on their way. */
  #paging = 0
  #kept = 0

  constructor(
    readonly index: CloudIndex,
    readonly survey: Survey,
    readonly source: Source,
    private readonly complain: (error: unknown) => void,
  ) {
    this.coloured = index.has_colours === true
    this.sheets = index.sheets.map(({ name, url, bounds_m, points }) => ({
      name,
      url,
      points,
      bounds: { min: [bounds_m[0], bounds_m[1], bounds_m[2]], max: [bounds_m[3], bounds_m[4], bounds_m[5]] },
      open: null,
      copc: null,
      scale: [1, 1, 1],
      offset: [0, 0, 0],
      nodes: new Map(),
      pages: new Map(),
      asked: new Map(),
    }))
  }

  get loading(): number {
    return this.#running + this.#queue.length + this.#paging
  }

  /** Open the sheets of a small cloud, and load the coarsest points of each. */
  async begin(): Promise<void> {
    if (this.sheets.length > MOST_AT_FIRST) return
    await Promise.all(this.sheets.map(async (sheet) => {
      await this.open(sheet)
      const root = sheet.nodes.get('0-0-0-0')
      if (root) await this.load(root, true)
    }))
  }

  /** Read a sheet's header and its first page of nodes, once. */
  open(sheet: Sheet): Promise<void> {
    sheet.open ??= this.#open(sheet).catch((error) => this.complain(error))
    return sheet.open
  }

  async #open(sheet: Sheet): Promise<void> {
    const copc = await Copc.create((begin, end) => this.source.bytes(sheet.url, begin, end))
    const { horizontal_unit, vertical_unit } = this.survey.crs
    const units = [horizontal_unit.m, horizontal_unit.m, vertical_unit.m]
    for (let axis = 0; axis < 3; axis++) {
      sheet.scale[axis] = copc.header.scale[axis]! * units[axis]!
      sheet.offset[axis] = copc.header.offset[axis]! * units[axis]!
    }
    this.coloured ||= copc.header.pointDataRecordFormat > 6
    sheet.copc = copc
    await this.#page(sheet, copc.info.rootHierarchyPage)
    this.arrived()
  }

  async #page(sheet: Sheet, page: Hierarchy.Page): Promise<void> {
    const { nodes, pages } = await Copc.loadHierarchyPage((begin, end) => this.source.bytes(sheet.url, begin, end), page)
    for (const [key, node] of Object.entries(nodes)) if (node) sheet.nodes.set(key, this.#node(sheet, key, node.pointCount))
    for (const [key, one] of Object.entries(pages)) if (one) sheet.pages.set(key, one)
    Object.entries(nodes).forEach(([key, node]) => node && this.#places.set(sheet.nodes.get(key)!, node))
  }

  readonly #places = new WeakMap<CloudNode, Hierarchy.Node>()

  #node(sheet: Sheet, key: string, count: number): CloudNode {
    const [depth, x, y, z] = key.split('-').map(Number) as [number, number, number, number]
    const { cube, spacing } = sheet.copc!.info
    const { horizontal_unit, vertical_unit } = this.survey.crs
    const units = [horizontal_unit.m, horizontal_unit.m, vertical_unit.m]
    const edges = [0, 1, 2].map((axis) => ((cube[axis + 3]! - cube[axis]!) / 2 ** depth) * units[axis]!)
    const min = [x, y, z].map((step, axis) => cube[axis]! * units[axis]! + step * edges[axis]!) as [number, number, number]
    const max = min.map((one, axis) => one + edges[axis]!) as [number, number, number]
    const middle = centre({ min, max })
    // An octree's cube is as high as it is wide: the sheet's own bounds are closer.
    for (let axis = 0; axis < 3; axis++) {
      min[axis] = Math.max(min[axis]!, sheet.bounds.min[axis]! - 0.01)
      max[axis] = Math.min(max[axis]!, sheet.bounds.max[axis]! + 0.01)
    }
    const box = { min, max }
    const spacing_m = (spacing * horizontal_unit.m) / 2 ** depth
    return { key, sheet, depth, box, spacing_m, count, origin: centre(box), middle, points: null, loading: null, failed: false, used: 0 }
  }

  /** The nodes below a node that are known; a page of the hierarchy that names them is asked for. */
  children(node: CloudNode): CloudNode[] {
    const found: CloudNode[] = []
    for (const key of keysBelow(node)) {
      const child = node.sheet.nodes.get(key)
      if (child) found.push(child)
      else void this.#pageOf(node.sheet, key)
    }
    return found
  }

  #pageOf(sheet: Sheet, key: string): Promise<void> | undefined {
    const page = sheet.pages.get(key)
    if (page) {
      sheet.pages.delete(key)
      this.#paging++
      sheet.asked.set(key, this.#page(sheet, page).catch(this.complain).finally(() => {
        this.#paging--
        this.arrived()
      }))
    }
    return sheet.asked.get(key)
  }

  /** Fetch and decode a node's points; those that are asked for last come first. One that is `needed` is not given up. */
  load(node: CloudNode, needed = false): Promise<void> {
    node.used = this.turn
    if (node.points || node.failed || !node.count) return Promise.resolve()
    const waiting = needed && this.#queue.find((one) => one.node === node)
    if (waiting) waiting.needed = true
    node.loading ??= new Promise<void>((resolve) => {
      this.#queue.push({ node, needed, start: () => void this.#fetch(node).finally(resolve) })
      this.#pump()
    })
    return node.loading
  }

  /** Forget the nodes that wait and are not wanted any more. */
  cancelBefore(turn: number): void {
    for (let index = this.#queue.length - 1; index >= 0; index--) {
      const { node, needed } = this.#queue[index]!
      if (needed || node.used >= turn) continue
      node.loading = null
      this.#queue.splice(index, 1)
    }
  }

  #pump(): void {
    while (this.#running < AT_ONCE && this.#queue.length) {
      let next = 0
      for (let index = 1; index < this.#queue.length; index++) {
        const [a, b] = [this.#queue[index]!.node, this.#queue[next]!.node]
        if (a.used > b.used || (a.used === b.used && a.depth < b.depth)) next = index
      }
      this.#running++
      this.#queue.splice(next, 1)[0]!.start()
    }
  }

  async #fetch(node: CloudNode): Promise<void> {
    const { sheet } = node
    const { header } = sheet.copc!
    const { pointDataOffset, pointDataLength } = this.#places.get(node)!
    try {
      const bytes = await this.source.bytes(sheet.url, pointDataOffset, pointDataOffset + pointDataLength)
      node.points = await this.#decoders.decode({
        bytes: bytes.slice(),
        count: node.count,
        format: header.pointDataRecordFormat,
        recordBytes: header.pointDataRecordLength,
        scale: sheet.scale,
        offset: sheet.offset,
        origin: node.origin,
        middle: node.middle,
      })
      this.#kept += node.count
      this.#forget()
    } catch (error) {
      node.failed = true
      this.complain(error)
    } finally {
      node.loading = null
      this.#running--
      this.#pump()
      this.arrived()
    }
  }

  /** Called with nodes whose points are dropped, so that the picture drops them as well. */
  dropped: (node: CloudNode) => void = () => {}

  #forget(): void {
    if (this.#kept <= KEPT_POINTS) return
    const old = this.ready().filter((node) => node.used < this.turn).sort((a, b) => a.used - b.used || b.depth - a.depth)
    for (const node of old) {
      if (this.#kept <= KEPT_POINTS * 0.8) return
      node.points = null
      this.#kept -= node.count
      this.dropped(node)
    }
  }

  /** All nodes whose points are here. */
  ready(): CloudNode[] {
    const found: CloudNode[] = []
    for (const sheet of this.sheets) for (const node of sheet.nodes.values()) if (node.points) found.push(node)
    return found
  }

  /** The full coordinate of a point (m), from the file's whole numbers. */
  coordinate(node: CloudNode, index: number): [number, number, number] {
    const { raw } = node.points!
    const { scale, offset } = node.sheet
    return [0, 1, 2].map((axis) => raw[index * 3 + axis]! * scale[axis]! + offset[axis]!) as [number, number, number]
  }

  /** Load all nodes whose boxes pass a test, at most so many points, coarse ones first; `whole` tells whether that is all. */
  async within(test: (box: Box) => boolean, mostPoints: number, finest_m = 0): Promise<{ nodes: CloudNode[]; whole: boolean }> {
    const meeting = this.sheets.filter((sheet) => test(sheet.bounds))
    await Promise.all(meeting.map((sheet) => this.open(sheet)))
    const found: CloudNode[] = []
    let level = meeting.flatMap((sheet) => sheet.nodes.get('0-0-0-0') ?? [])
    let [points, whole] = [0, true]
    while (level.length) {
      const below: CloudNode[] = []
      for (const node of level) {
        if (!test(node.box)) continue
        if (points + node.count > mostPoints) {
          whole = false
          continue
        }
        points += node.count
        found.push(node)
        if (node.spacing_m > finest_m) below.push(...(await this.#allChildren(node)))
      }
      level = below
    }
    await Promise.all(found.map((node) => this.load(node, true)))
    return { nodes: found.filter((node) => node.points), whole: whole && !found.some((node) => node.failed) }
  }

  async #allChildren(node: CloudNode): Promise<CloudNode[]> {
    await Promise.all(keysBelow(node).map((key) => this.#pageOf(node.sheet, key)))
    return this.children(node)
  }
}

function keysBelow(node: CloudNode): string[] {
  const [depth, x, y, z] = node.key.split('-').map(Number) as [number, number, number, number]
  return Array.from({ length: 8 }, (_, corner) => `${depth + 1}-${2 * x + (corner & 1)}-${2 * y + ((corner >> 1) & 1)}-${2 * z + (corner >> 2)}`)
}

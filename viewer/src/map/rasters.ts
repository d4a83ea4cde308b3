/** Raster pyramids: tiles that exist are fetched, values are kept for reading back, colours are made here. */

import TileLayer from 'ol/layer/Tile'
import type Projection from 'ol/proj/Projection'
import ImageTileSource from 'ol/source/ImageTile'
import TileGrid from 'ol/tilegrid/TileGrid'
import { scale } from '../core/scales'
import type { Raster, RasterGrid, RasterLevel } from '../core/site'
import type { Source } from '../core/source'

const KEPT_TILES = 96
const EMPTY = -1

/** Which tiles of a level exist. */
class TileList {
  readonly #rows = new Map<number, [number, number][]>()

  constructor(document: { rows: [number, [number, number][]][] }) {
    for (const [row, runs] of document.rows) this.#rows.set(row, runs)
  }

  has(column: number, row: number): boolean {
    return this.#rows.get(row)?.some(([first, last]) => first <= column && column <= last) ?? false
  }
}

/** The grid that all rasters share. OpenLayers counts levels from the coarsest, and rows downwards. */
export class Pyramid {
  readonly levels: RasterLevel[]
  readonly grid: TileGrid
  readonly #lists = new Map<number, Promise<TileList>>()

  constructor(
    document: RasterGrid,
    readonly source: Source,
  ) {
    this.levels = [...document.levels].sort((a, b) => b.level - a.level)
    this.grid = new TileGrid({
      origin: [0, 0],
      tileSize: document.tile_px,
      resolutions: this.levels.map((level) => level.pixel_m),
    })
  }

  list(z: number): Promise<TileList> {
    let list = this.#lists.get(z)
    if (!list) {
      list = this.source.json<any>(this.levels[z]!.tiles).then((document) => new TileList(document))
      this.#lists.set(z, list)
    }
    return list
  }
}

interface Values {
  /** Numbers of a tile, row by row from the north; -1 where there is no data. */
  numbers: Int32Array
  edge: number
}

/** One raster as a layer of the map. */
export class RasterLayer {
  readonly layer: TileLayer<ImageTileSource>
  from: number
  to: number
  colours: string
  readonly #kept = new Map<string, Promise<Values | null>>()
  readonly #blank = document.createElement('canvas')

  constructor(
    readonly raster: Raster,
    readonly pyramid: Pyramid,
    projection: Projection,
    private readonly complain: (error: unknown) => void,
  ) {
    ;[this.from, this.to, this.colours] = [raster.from, raster.to, raster.colours]
    const edge = pyramid.grid.getTileSize(0) as number
    ;[this.#blank.width, this.#blank.height] = [edge, edge]
    this.layer = new TileLayer({ source: this.#source(projection, edge), visible: raster.visible, zIndex: raster.order })
  }

  #source(projection: Projection, edge: number): ImageTileSource {
    return new ImageTileSource({
      projection,
      tileGrid: this.pyramid.grid,
      tileSize: edge,
      interpolate: false,
      transition: 120,
      wrapX: false,
      loader: async (z, x, y) => {
        const values = await this.values(z, x, -1 - y)
        return values ? this.#paint(values) : this.#blank
      },
    })
  }

  /** Show values between two limits, in a scale. */
  restyle(from: number, to: number, colours: string): void {
    ;[this.from, this.to, this.colours] = [from, to, colours]
    this.layer.getSource()!.refresh()
  }

  /** The value at a place of the finest level whose tile is listed, and the size of its pixel; null where there is none. */
  async read(easting_m: number, northing_m: number, coarsest_m: number): Promise<{ value: number; pixel_m: number } | null> {
    for (let z = this.pyramid.levels.length - 1; z >= 0; z--) {
      const { pixel_m, tile_m } = this.pyramid.levels[z]!
      if (pixel_m < coarsest_m / 4 && z > 0) continue
      const [column, row] = [Math.floor(easting_m / tile_m), Math.floor(northing_m / tile_m)]
      const values = await this.values(z, column, row)
      if (!values) continue
      const x = Math.min(values.edge - 1, Math.floor((easting_m - column * tile_m) / pixel_m))
      const y = Math.min(values.edge - 1, Math.floor(((row + 1) * tile_m - northing_m) / pixel_m))
      const number = values.numbers[Math.max(0, y) * values.edge + Math.max(0, x)]!
      return number === EMPTY ? null : { value: this.raster.offset + this.raster.step * number, pixel_m }
    }
    return null
  }

  values(z: number, column: number, row: number): Promise<Values | null> {
    const name = `${z}/${column}/${row}`
    const kept = this.#kept.get(name)
    if (kept) {
      this.#kept.delete(name)
      this.#kept.set(name, kept)
      return kept
    }
    const loading = this.#load(z, column, row).catch((error) => {
      this.#kept.delete(name)
      this.complain(error)
      return null
    })
    this.#kept.set(name, loading)
    if (this.#kept.size > KEPT_TILES) this.#kept.delete(this.#kept.keys().next().value!)
    return loading
  }

  async #load(z: number, column: number, row: number): Promise<Values | null> {
    const level = this.pyramid.levels[z]!
    if (!(await this.pyramid.list(z)).has(column, row)) return null
    const path = this.raster.url
      .replace('{level}', String(level.level))
      .replace('{column}', String(column))
      .replace('{row}', String(row))
    const blob = await this.pyramid.source.blob(path, 'image/png')
    const bitmap = await createImageBitmap(blob, { premultiplyAlpha: 'none', colorSpaceConversion: 'none' })
    const canvas = new OffscreenCanvas(bitmap.width, bitmap.height)
    const context = canvas.getContext('2d', { willReadFrequently: true })!
    context.drawImage(bitmap, 0, 0)
    bitmap.close()
    const { data } = context.getImageData(0, 0, canvas.width, canvas.height)
    const numbers = new Int32Array(canvas.width * canvas.height)
    const wide = this.raster.encoding === 'rgb24'
    for (let index = 0, at = 0; index < numbers.length; index++, at += 4) {
      if (data[at + 3]! < 255) numbers[index] = EMPTY
      else numbers[index] = wide ? (data[at]! << 16) | (data[at + 1]! << 8) | data[at + 2]! : data[at]!
    }
    return { numbers, edge: canvas.width }
  }

  #paint(values: Values): HTMLCanvasElement {
    const canvas = document.createElement('canvas')
    canvas.width = values.edge
    canvas.height = values.numbers.length / values.edge
    const context = canvas.getContext('2d')!
    const image = context.createImageData(canvas.width, canvas.height)
    const [colours, { offset, step }] = [scale(this.colours), this.raster]
    const [low, factor] = [this.from, 255 / (this.to - this.from || 1)]
    for (let index = 0, at = 0; index < values.numbers.length; index++, at += 4) {
      const number = values.numbers[index]!
      if (number === EMPTY) continue
      const colour = 3 * Math.max(0, Math.min(255, Math.round((offset + step * number - low) * factor)))
      image.data[at] = colours[colour]!
      image.data[at + 1] = colours[colour + 1]!
      image.data[at + 2] = colours[colour + 2]!
      image.data[at + 3] = 255
    }
    context.putImageData(image, 0, 0)
    return canvas
  }
}

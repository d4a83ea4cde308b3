/** All pictures near a place, and which of them show it best. */

import { type Camera, meets, type PictureColumns, type PictureIndex } from '../core/site'
import type { Source } from '../core/source'
import { pixelOf, pixelSize, type Pose } from './geometry'

const FARTHEST_M = 80

export interface Picture extends Pose {
  id: number
  camera: Camera
  url: string
  epoch_gps_ns: string
  sigma_m: number | null
  name: string
}

export interface View {
  picture: Picture
  u: number
  v: number
  distance_m: number
  /** Metres that a pixel covers there. */
  pixel_m: number
  /** Something nearer stands before it, as far as the cloud tells. */
  hidden: boolean
  /** What the list says of it in place of distance and pixel. */
  note?: string
}

export class PictureList {
  readonly #parts = new Map<string, Promise<Picture[]>>()
  readonly #cameras: Map<number, Camera>

  constructor(
    readonly index: PictureIndex,
    readonly source: Source,
  ) {
    this.#cameras = new Map(index.cameras.map((one) => [one.camera, one]))
  }

  #part(url: string): Promise<Picture[]> {
    let part = this.#parts.get(url)
    if (!part) this.#parts.set(url, (part = this.#load(url)))
    return part
  }

  async #load(url: string): Promise<Picture[]> {
    const columns = await this.source.json<PictureColumns>(url)
    return columns.id.flatMap((id, index) => {
      const camera = this.#cameras.get(columns.camera[index]!)
      if (!camera) return []
      return {
        id,
        camera,
        url: columns.url[index]!,
        epoch_gps_ns: columns.epoch_gps_ns[index]!,
        easting_m: columns.easting_m[index]!,
        northing_m: columns.northing_m[index]!,
        height_m: columns.height_m[index]!,
        camera_from_map: columns.camera_from_map[index]!,
        sigma_m: columns.sigma_m?.[index] ?? null,
        name: columns.name?.[index] ?? '',
      }
    })
  }

  async near(easting_m: number, northing_m: number, reach_m = FARTHEST_M): Promise<Picture[]> {
    const box = [easting_m - reach_m, northing_m - reach_m, easting_m + reach_m, northing_m + reach_m] as [number, number, number, number]
    const parts = await Promise.all(this.index.parts.filter((part) => meets(part.bounds_m, box)).map((part) => this.#part(part.url)))
    return parts.flat().filter((one) => Math.hypot(one.easting_m - easting_m, one.northing_m - northing_m) <= reach_m)
  }

  async byUrl(url: string): Promise<Picture | null> {
    for (const part of this.index.parts) {
      const found = (await this.#part(part.url)).find((one) => one.url === url)
      if (found) return found
    }
    return null
  }

  async all(): Promise<Picture[]> {
    return (await Promise.all(this.index.parts.map((part) => this.#part(part.url)))).flat()
  }

  /** Pictures that see a place, the one with the finest pixels there first; those that show it at their rim come later. */
  async seeing(place: readonly [number, number, number]): Promise<View[]> {
    const views: (View & { cost: number })[] = []
    for (const picture of await this.near(place[0], place[1])) {
      const pixel = pixelOf(picture.camera, picture, place)
      if (!pixel) continue
      const pixel_m = pixelSize(picture.camera, pixel.distance_m)
      views.push({ picture, ...pixel, pixel_m, hidden: false, cost: pixel_m * (atRim(picture.camera, pixel) ? 2 : 1) })
    }
    return views.sort((a, b) => a.cost - b.cost || a.picture.id - b.picture.id)
  }
}

function atRim(camera: Camera, { u, v }: { u: number; v: number }): boolean {
  const rim = 0.06
  const [x, y] = [u / camera.width_px, v / camera.height_px]
  const high = y < rim || y > 1 - rim
  return camera.model === 'equirectangular' ? high : high || x < rim || x > 1 - rim
}

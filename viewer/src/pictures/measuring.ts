/** Measuring in pictures: a line on the ground by one picture, a place by two. The server computes both. */

import Feature from 'ol/Feature'
import LineString from 'ol/geom/LineString'
import Point from 'ol/geom/Point'
import Fill from 'ol/style/Fill'
import Stroke from 'ol/style/Stroke'
import OlStyle from 'ol/style/Style'
import Text from 'ol/style/Text'
import type { Desk } from '../core/desk'
import * as format from '../core/format'
import { post } from '../core/server'
import type { MapView } from '../map/map'
import { measuring } from '../map/styles'
import type { Measurements } from '../panels/measurements'
import { saveFile } from '../strips/section'
import { pixelOf, rayOf } from './geometry'
import type { Picture, PictureList, View } from './list'
import type { PictureDrawing, PictureView } from './view'

type Pixel = [number, number]

interface Place {
  easting_m: number | null
  northing_m: number | null
  height_m: number | null
  sigma_easting_m: number | null
  sigma_northing_m: number | null
  sigma_height_m: number | null
  distance_m: number | null
  reason: string
  warning: string
}

interface Answer {
  places: Place[]
  assumed: string
  length_m: number | null
  sigma_length_m: number | null
  /** By how much the rays of two pictures pass each other. */
  gap_m: number | null
  geojson: object | null
}

/** Distances (m) along a ray at which its line is drawn in another picture. */
const ALONG = Array.from({ length: 90 }, (_, step) => 0.8 * 1.06 ** step)
/** Distance (m) at which pictures are compared as partners of a first click: that of most things beside a road. */
const USUAL_M = 10
const FARTHEST_PARTNER_M = 40

export class PictureMeasuring {
  #picture: Picture | null = null
  #pixels: Pixel[] = []
  #number = 0

  constructor(
    readonly desk: Desk,
    readonly map: MapView,
    readonly measurements: Measurements,
    readonly view: PictureView,
    readonly list: PictureList,
    readonly path: string,
    /** Says what to do next. */
    readonly tell: (text: string) => void,
  ) {
    view.tool.on(() => this.abort())
  }

  /** Give up what is being measured. */
  abort(): void {
    this.#picture = null
    this.#pixels = []
    this.view.setDrawings('drawn', null)
  }

  clicked(picture: Picture, pixel: Pixel): void {
    if (this.view.tool.value === 'line') this.#corner(picture, pixel)
    else if (!this.#picture || this.#picture === picture) void this.#first(picture, pixel).catch((error) => this.desk.complain(error))
    else void this.#second(this.#picture, picture, pixel)
  }

  // ---- a line by one picture ----

  #corner(picture: Picture, pixel: Pixel): void {
    if (this.#picture !== picture) this.abort()
    this.#picture = picture
    const last = this.#pixels.at(-1)
    if (!last || Math.hypot(last[0] - pixel[0], last[1] - pixel[1]) > 0.5) this.#pixels.push(pixel) // a double click is two
    const pixels = [...this.#pixels]
    this.view.setDrawings('drawn', (shown) => (shown === picture ? [{ points: pixels, dots: true }] : []))
  }

  /** The line ends: its places are asked for. */
  async end(): Promise<void> {
    const [picture, pixels] = [this.#picture, this.#pixels]
    if (this.view.tool.value !== 'line' || !picture || !pixels.length) return
    this.abort()
    try {
      const answer = await post<Answer>(this.path, JSON.stringify({ pictures: [picture.name], pixels }))
      const lost = answer.places.filter((one) => one.reason)
      if (!answer.geojson) return this.desk.complain(`Nothing was measured: ${lost[0]!.reason}.`)
      const notes = [...new Set(lost.map((one) => one.reason))].map((reason) => `Left out: ${reason}.`)
      this.#add(pixels.length > 1 ? 'Line in a picture' : 'Place in a picture', answer, [...notes], (shown) => (shown === picture ? [{ points: pixels, dots: true, label: labelOf(answer) }] : []))
    } catch (error) {
      this.desk.complain(error)
    }
  }

  // ---- a place by two pictures ----

  async #first(picture: Picture, pixel: Pixel): Promise<void> {
    this.#picture = picture
    this.#pixels = [pixel]
    this.view.setDrawings('drawn', (shown) => (shown === picture ? [{ points: [pixel], dots: true, label: '1' }] : [{ points: epipolar(picture, pixel, shown), dots: false }]))
    const partners = await this.#partners(picture, pixel)
    this.view.offer(partners)
    this.tell(partners.length ? 'Open another picture in the list below, and click the same thing on the yellow line.' : 'No other picture sees along this ray.')
  }

  /** Other pictures that see along a ray, those with the widest angle first. */
  async #partners(picture: Picture, pixel: Pixel): Promise<View[]> {
    const ray = rayOf(picture.camera, picture, ...pixel)
    const usual = along(picture, ray, USUAL_M)
    const near = await this.list.near(picture.easting_m, picture.northing_m, FARTHEST_PARTNER_M)
    const views = near.flatMap((other): (View & { angle: number })[] => {
      const seen = other === picture ? null : pixelOf(other.camera, other, usual)
      if (!seen) return []
      const [a, b] = [picture, other].map((one) => [usual[0] - one.easting_m, usual[1] - one.northing_m, usual[2] - one.height_m] as const) as [readonly [number, number, number], readonly [number, number, number]]
      const cosine = (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) / (Math.hypot(...a) * Math.hypot(...b))
      const angle = (Math.acos(Math.min(1, cosine)) * 180) / Math.PI
      return [{ picture: other, ...seen, pixel_m: 0, hidden: false, angle, note: `${format.fixed(angle, 0)}° at ${USUAL_M} m` }]
    })
    return views.sort((a, b) => b.angle - a.angle || a.picture.id - b.picture.id)
  }

  async #second(first: Picture, second: Picture, pixel: Pixel): Promise<void> {
    const pixels = [this.#pixels[0]!, pixel]
    try {
      const answer = await post<Answer>(this.path, JSON.stringify({ pictures: [first.name, second.name], pixels }))
      this.abort()
      const drawn = (shown: Picture): PictureDrawing[] => (shown === first ? [{ points: [pixels[0]!], dots: true }] : shown === second ? [{ points: [pixel], dots: true }] : [])
      this.#add('Place by two pictures', answer, [], drawn)
    } catch (error) {
      this.desk.complain(error)
    }
  }

  // ---- what was measured ----

  #add(title: string, answer: Answer, notes: string[], drawn: (shown: Picture) => PictureDrawing[]): void {
    const name = `measured-${++this.#number}`
    const places = answer.places.filter((one) => !one.reason)
    const points = places.map((one) => [one.easting_m!, one.northing_m!, one.height_m!] as [number, number, number])
    const feature = this.#onMap(points, labelOf(answer))
    this.view.setDrawings(name, drawn)
    const last = places.at(-1)!
    const lines: [string, string][] = places.length > 1
      ? [['Length', `${format.metres(answer.length_m, 3)} ± ${format.length(answer.sigma_length_m!)}`], ['Corners', `${places.length} of ${answer.places.length}`], ['σ of corners', range(places)]]
      : [['Easting', stated(last.easting_m, last.sigma_easting_m)], ['Northing', stated(last.northing_m, last.sigma_northing_m)], ['Height', stated(last.height_m, last.sigma_height_m)]]
    if (answer.gap_m !== null) lines.push(['The rays pass by', format.length(answer.gap_m)])
    const warnings = places.filter((one) => one.warning).map((one) => `Beware: ${one.warning}.`)
    this.measurements.add({
      title, lines, points,
      notes: [...warnings, ...notes, ...(answer.assumed ? [`Assumed: ${answer.assumed}.`] : [])],
      save: () => saveFile(`${title.toLowerCase().replaceAll(' ', '-')}.geojson`, 'application/geo+json', JSON.stringify(answer.geojson, null, 1)),
      remove: () => {
        this.map.measuring.source.removeFeature(feature)
        this.view.setDrawings(name, null)
      },
    })
    this.desk.message.value = null
    if (points.length === 1) this.desk.place.value = { easting_m: points[0]![0], northing_m: points[0]![1], height_m: points[0]![2], from: 'picture' }
    const middle = points[points.length >> 1]!
    this.desk.goTo({ easting_m: middle[0], northing_m: middle[1], height_m: middle[2], across_m: Math.max(10, 2 * (answer.length_m ?? 0)) })
  }

  #onMap(points: [number, number, number][], label: string): Feature {
    const feature = new Feature(points.length > 1 ? new LineString(points) : new Point(points[0]!))
    feature.setStyle(() => {
      const dark = this.desk.dark.value
      const text = new Text({ text: label, font: '600 13px system-ui, sans-serif', offsetY: -14, fill: new Fill({ color: dark ? '#ffd43b' : '#c2255c' }), stroke: new Stroke({ color: dark ? '#000' : '#fff', width: 4 }) })
      return [...measuring(dark), new OlStyle({ text })]
    })
    this.map.measuring.source.addFeature(feature)
    return feature
  }
}

function along(picture: Picture, ray: readonly [number, number, number], distance_m: number): [number, number, number] {
  return [picture.easting_m + distance_m * ray[0], picture.northing_m + distance_m * ray[1], picture.height_m + distance_m * ray[2]]
}

/** The line in a second picture on which whatever a pixel of the first shows must lie. */
function epipolar(first: Picture, pixel: Pixel, second: Picture): Pixel[] {
  const ray = rayOf(first.camera, first, ...pixel)
  return ALONG.flatMap((distance_m): Pixel[] => {
    const seen = pixelOf(second.camera, second, along(first, ray, distance_m))
    return seen ? [[seen.u, seen.v]] : []
  })
}

function labelOf({ length_m, sigma_length_m }: Answer): string {
  return length_m ? `${format.metres(length_m, 3)} ± ${format.length(sigma_length_m!)}` : ''
}

function stated(value_m: number | null, sigma_m: number | null): string {
  return `${format.metres(value_m, 3)} ± ${sigma_m === null ? '?' : format.length(sigma_m)}`
}

/** The least and the greatest horizontal σ. */
function range(places: readonly Place[]): string {
  const sigmas = places.map((one) => Math.hypot(one.sigma_easting_m ?? 0, one.sigma_northing_m ?? 0))
  const [low, high] = [Math.min(...sigmas), Math.max(...sigmas)].map((one) => format.length(one))
  return low === high ? low! : `${low} to ${high}`
}

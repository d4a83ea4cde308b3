/** Measuring on the map: lengths and areas in the survey's own plane, as its coordinates give them. */

import type Feature from 'ol/Feature'
import type Polygon from 'ol/geom/Polygon'
import LineString from 'ol/geom/LineString'
import Draw from 'ol/interaction/Draw'
import type OlMap from 'ol/Map'
import VectorLayer from 'ol/layer/Vector'
import VectorSource from 'ol/source/Vector'
import type { Signal } from '../core/signal'
import { measuring } from './styles'

export type MapTool = 'select' | 'distance' | 'area' | 'section'

export interface Measured {
  kind: Exclude<MapTool, 'select'>
  points: [number, number][]
  length_m: number
  area_m2: number | null
}

/** Draws what is measured; `done` gets each finished figure, `doing` the one that is being drawn. */
export class Measuring {
  readonly source = new VectorSource()
  readonly layer: VectorLayer<VectorSource>
  #draw: Draw | null = null
  /** The last corner that came from the keyboard. */
  #corner: readonly number[] | null = null

  constructor(
    private readonly map: OlMap,
    private readonly dark: Signal<boolean>,
    private readonly done: (measured: Measured, feature: Feature) => void,
    private readonly doing: (measured: Measured | null) => void,
  ) {
    this.layer = new VectorLayer({ source: this.source, zIndex: 5000 })
    dark.on((on) => this.layer.setStyle(measuring(on)), true)
  }

  use(tool: MapTool): void {
    if (this.#draw) this.map.removeInteraction(this.#draw)
    this.#draw = null
    this.#corner = null
    this.doing(null)
    if (tool === 'select') return
    const draw = new Draw({
      source: this.source,
      type: tool === 'area' ? 'Polygon' : 'LineString',
      ...(tool === 'section' ? { maxPoints: 2 } : {}),
      style: measuring(this.dark.value),
    })
    draw.on('drawstart', ({ feature }) => {
      feature.getGeometry()!.on('change', () => this.doing(measure(feature as Feature, tool)))
    })
    draw.on('drawend', ({ feature }) => {
      this.doing(null)
      this.done(measure(feature as Feature, tool), feature as Feature)
    })
    this.map.addInteraction(draw)
    this.#draw = draw
  }

  /** Take a corner from the keyboard; a second one at the same place ends what is drawn. */
  corner(place: readonly number[]): void {
    const again = this.#corner?.every((value, axis) => value === place[axis])
    this.#corner = again ? null : place
    if (again) this.#draw?.finishDrawing()
    else this.#draw?.appendCoordinates([[...place]])
  }

  get busy(): boolean {
    return this.#draw !== null
  }

  abort(): void {
    this.#corner = null
    this.#draw?.abortDrawing()
    this.doing(null)
  }

  remove(feature: Feature): void {
    this.source.removeFeature(feature)
  }
}

function measure(feature: Feature, kind: Measured['kind']): Measured {
  const geometry = feature.getGeometry() as LineString | Polygon
  const line = geometry instanceof LineString ? geometry.getCoordinates() : geometry.getCoordinates()[0]!
  const points = line.map(([easting, northing]) => [easting!, northing!] as [number, number])
  return { kind, points, length_m: lengthOf(points), area_m2: kind === 'area' ? areaOf(points) : null }
}

export function lengthOf(points: readonly (readonly [number, number])[]): number {
  let sum = 0
  for (let index = 1; index < points.length; index++) {
    sum += Math.hypot(points[index]![0] - points[index - 1]![0], points[index]![1] - points[index - 1]![1])
  }
  return sum
}

/** Area of a ring by Gauss's formula, about its first point so that no digits are lost. */
export function areaOf(ring: readonly (readonly [number, number])[]): number {
  if (ring.length < 3) return 0
  const [e, n] = ring[0]!
  let twice = 0
  for (let index = 0; index < ring.length; index++) {
    const [a, b] = [ring[index]!, ring[(index + 1) % ring.length]!]
    twice += (a[0] - e) * (b[1] - n) - (b[0] - e) * (a[1] - n)
  }
  return Math.abs(twice) / 2
}

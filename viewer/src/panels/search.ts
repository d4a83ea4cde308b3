/** What people type into the search box. */

import type { Bounds, Degrees, FeatureDocument } from '../core/site'
import type { FeatureLayer } from '../map/vectors'

export type Wanted =
  | { kind: 'place'; easting_m: number; northing_m: number; height_m: number | null }
  | { kind: 'degrees'; latitude_deg: number; longitude_deg: number }
  | { kind: 'tile'; tile: string }
  | { kind: 'row'; layer: string; id: string }
  | { kind: 'station'; station_m: number }
  | { kind: 'text'; text: string }

/** Numbers within the range of degrees are degrees, unless a local map has places there (`bounds`). */
export function parseSearch(text: string, bounds: Bounds | null = null): Wanted {
  const trimmed = text.trim()
  const station = /^@\s*(-?\d+(?:\.\d+)?)$/.exec(trimmed)
  if (station) return { kind: 'station', station_m: Number(station[1]) }
  if (/^-?\d+_-?\d+$/.test(trimmed)) return { kind: 'tile', tile: trimmed }
  const row = /^([a-z0-9_]+)\/(.+)$/i.exec(trimmed)
  if (row) return { kind: 'row', layer: row[1]!, id: row[2]! }
  const degrees = lettered(trimmed)
  if (degrees) return degrees
  const numbers = trimmed.replace(/\u202f/g, '').split(/[\s;,]+/).filter(Boolean).map(Number)
  if ((numbers.length === 2 || numbers.length === 3) && numbers.every(Number.isFinite)) {
    const [first, second] = numbers as [number, number]
    const isOnMap = bounds !== null && bounds[0] <= first && first <= bounds[2] && bounds[1] <= second && second <= bounds[3]
    if (numbers.length === 2 && Math.abs(first) <= 90 && Math.abs(second) <= 180 && !isOnMap) return { kind: 'degrees', latitude_deg: first, longitude_deg: second }
    return { kind: 'place', easting_m: first, northing_m: second, height_m: numbers[2] ?? null }
  }
  return { kind: 'text', text: trimmed }
}

/** Degrees with letters, such as `48.1° N, 11.5° E`, in either order. */
function lettered(text: string): Wanted | null {
  const part = '(\\d+(?:\\.\\d+)?)\\s*°?\\s*'
  const match = new RegExp(`^${part}([NSEW])[\\s,;]+${part}([NSEW])$`, 'i').exec(text)
  if (!match) return null
  const read = (letters: string): number | null => {
    const at = [2, 4].find((one) => letters.includes(match[one]!.toUpperCase()))
    return at === undefined ? null : Number(match[at - 1]) * (letters[1] === match[at]!.toUpperCase() ? -1 : 1)
  }
  const [latitude_deg, longitude_deg] = [read('NS'), read('EW')]
  return latitude_deg === null || longitude_deg === null ? null : { kind: 'degrees', latitude_deg, longitude_deg }
}

/** Easting and northing (m) of degrees; null outside of where the polynomials hold. */
export function onMap({ middle, half, degree, easting, northing }: Degrees, longitude_deg: number, latitude_deg: number): [number, number] | null {
  const [x, y] = [(longitude_deg - middle[0]) / half[0], (latitude_deg - middle[1]) / half[1]]
  if (Math.abs(x) > 1 || Math.abs(y) > 1) return null
  const place: [number, number] = [0, 0]
  let term = 0
  for (let i = 0; i <= degree; i++) {
    for (let j = 0; j <= degree - i; j++, term++) {
      const factor = x ** i * y ** j
      place[0] += easting[term]! * factor
      place[1] += northing[term]! * factor
    }
  }
  return place
}

export interface Found {
  layer: FeatureLayer
  feature: FeatureDocument
  text: string
}

/** More rows than these are not fetched to look for a name. */
const MOST_ROWS = 20_000
const MOST_FOUND = 30

/** Rows whose id, name or text holds what was typed, exact ones first; and layers that were too large to look through. */
export async function findRows(layers: readonly FeatureLayer[], text: string): Promise<{ found: Found[]; left: string[] }> {
  const wanted = text.toLowerCase()
  const exact: Found[] = []
  const others: Found[] = []
  const left: string[] = []
  for (const layer of layers) {
    const { document } = layer
    if (document.features > MOST_ROWS) {
      left.push(document.title)
      continue
    }
    const names = document.columns.filter((one) => ['text', '', null].includes(one.unit) || one.name === document.key || one.name === document.label).map((one) => one.name)
    const keys = new Set([...names, document.key, document.label])
    for (const feature of await layer.loadAll()) {
      const values = [...keys].map((one) => (one === null ? '' : String(feature.properties[one] ?? '')))
      const same = values.find((one) => one.toLowerCase() === wanted)
      const like = same ?? values.find((one) => one.toLowerCase().includes(wanted))
      if (like === undefined) continue
      const name = String(feature.properties[document.label ?? document.key ?? ''] ?? feature.id)
      ;(same === undefined ? others : exact).push({ layer, feature, text: `${document.title}: ${name}${like === name ? '' : ` (${like.slice(0, 60)})`}` })
    }
  }
  return { found: [...exact, ...others].slice(0, MOST_FOUND), left }
}

/** The layer of a kind, by its title or name: `pole` finds Poles. */
export function layerOfKind(layers: readonly FeatureLayer[], text: string): FeatureLayer | null {
  const plain = (one: string): string => one.toLowerCase().replace(/^asset_/, '').replace(/_/g, ' ').replace(/s$/, '')
  return layers.find(({ document }) => [document.title, document.name].some((one) => plain(one) === plain(text))) ?? null
}

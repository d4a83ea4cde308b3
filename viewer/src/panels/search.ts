/** What people type into the search box. */

export type Wanted =
  | { kind: 'place'; easting_m: number; northing_m: number; height_m: number | null }
  | { kind: 'tile'; tile: string }
  | { kind: 'row'; layer: string; id: string }
  | { kind: 'station'; station_m: number }
  | { kind: 'unknown' }

export function parseSearch(text: string): Wanted {
  const trimmed = text.trim()
  const station = /^@\s*(-?\d+(?:\.\d+)?)$/.exec(trimmed)
  if (station) return { kind: 'station', station_m: Number(station[1]) }
  if (/^-?\d+_-?\d+$/.test(trimmed)) return { kind: 'tile', tile: trimmed }
  const row = /^([a-z0-9_]+)\/(.+)$/i.exec(trimmed)
  if (row) return { kind: 'row', layer: row[1]!, id: row[2]! }
  const numbers = trimmed.replace(/\u202f/g, '').split(/[\s;,]+/).map(Number)
  if ((numbers.length === 2 || numbers.length === 3) && numbers.every(Number.isFinite)) {
    return { kind: 'place', easting_m: numbers[0]!, northing_m: numbers[1]!, height_m: numbers[2] ?? null }
  }
  return { kind: 'unknown' }
}

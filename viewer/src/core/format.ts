/** Numbers and times as people read them. */

const THIN = '\u202f'
const MINUS = '\u2212'

/** A number with fixed decimals, digits in threes, and a true minus sign. */
export function fixed(value: number, decimals: number): string {
  const [whole, part] = Math.abs(value).toFixed(decimals).split('.') as [string, string?]
  const grouped = whole.replace(/\B(?=(\d{3})+$)/g, THIN)
  const sign = value < 0 && Number(`${whole}.${part ?? 0}`) !== 0 ? MINUS : ''
  return sign + grouped + (part ? `.${part}` : '')
}

/** Metres with millimetres, or as many decimals as asked. */
export function metres(value: number | null | undefined, decimals = 3): string {
  return value === null || value === undefined || !Number.isFinite(value) ? '–' : `${fixed(value, decimals)}${THIN}m`
}

/** A length in the unit that reads best. */
export function length(value_m: number): string {
  const size = Math.abs(value_m)
  if (size >= 10_000) return `${fixed(value_m / 1000, 2)}${THIN}km`
  if (size >= 1) return `${fixed(value_m, 3)}${THIN}m`
  return `${fixed(value_m * 1000, 1)}${THIN}mm`
}

/** A value of a table: numbers with four digits of their own, all else as its text. */
export function value(raw: unknown): string {
  if (raw === null || raw === undefined) return '–'
  if (typeof raw === 'number') return Number.isInteger(raw) ? fixed(raw, 0) : number(raw)
  if (typeof raw === 'boolean') return raw ? 'yes' : 'no'
  if (raw === '') return '–'
  return typeof raw === 'string' ? raw : JSON.stringify(raw)
}

/** A number that is no whole one: millimetres of coordinates, four digits of small values. */
export function number(raw: number): string {
  const size = Math.abs(raw)
  if (size >= 1000) return fixed(raw, 3)
  if (size >= 1) return fixed(raw, 4).replace(/0{1,2}$/, '')
  if (size >= 1e-4 || size === 0) return String(Number(raw.toPrecision(4))).replace('-', MINUS)
  return raw.toExponential(2).replace('-', MINUS)
}

/** Square of a unit's text: `m` becomes `m²`. */
export const squared = (unit: string): string => `${unit}²`

const GPS_UNIX_S = 315_964_800n

/** A GPS epoch (ns, as text) as GPS date and time; leap seconds are not applied and the text says so. */
export function gpsTime(epoch: unknown): string {
  if (typeof epoch !== 'string' || !/^-?\d{1,19}$/.test(epoch)) return value(epoch)
  const ns = BigInt(epoch)
  const milliseconds = Number(ns / 1_000_000n + GPS_UNIX_S * 1000n)
  return `${new Date(milliseconds).toISOString().replace('T', ' ').replace('Z', '')} GPS`
}

/** A column's title for people: its first letter is large. */
export function titled(title: string): string {
  return title.slice(0, 1).toUpperCase() + title.slice(1)
}

/** The unit that stands beside a column's title or values; empty where they need none, as those of a date and time. */
export function unitOf({ name, unit }: { name: string; unit: string | null }): string {
  return unit && !['text', 'number', '1', 'date'].includes(unit) && !/_gps_ns$/.test(name) ? unit : ''
}

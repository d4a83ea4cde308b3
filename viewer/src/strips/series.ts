/** A quantity along a lane: bins of it and values in pieces, as a curve, and what it is at a station. */

import type uPlot from 'uplot'
import type { StripPiece, StripSeries } from '../core/site'

/** A series of bins with the values of some pieces in their place; a series of values as it is. */
export function refined(series: StripSeries, pieces: readonly (StripPiece & { series: StripSeries[] })[]): StripSeries {
  if (!series.low || !pieces.length) return series
  const parts: [StripSeries, number][] = []
  for (let index = 0; index < series.from_m.length; index++) {
    const middle = (series.from_m[index]! + series.to_m[index]!) / 2
    if (!pieces.some((one) => one.from_m <= middle && middle < one.to_m)) parts.push([series, index])
  }
  for (const piece of pieces) {
    const own = piece.series.find((one) => one.quantity === series.quantity && one.extent === series.extent)
    for (let index = 0; own && index < own.from_m.length; index++) parts.push([own, index])
  }
  parts.sort(([a, i], [b, j]) => a.from_m[i]! - b.from_m[j]!)
  const column = <T>(of: (one: StripSeries) => T[] | undefined): T[] => parts.map(([one, index]) => of(one)?.[index] ?? (null as T))
  return {
    quantity: series.quantity,
    extent: series.extent,
    from_m: column((one) => one.from_m),
    to_m: column((one) => one.to_m),
    value: column((one) => one.value),
    sigma: column((one) => one.sigma),
    share: column((one) => one.share),
    reason: column((one) => one.reason),
    low: column((one) => one.low),
    high: column((one) => one.high),
  }
}

/** Stations and values of a series; sections are steps, with a gap where none follows, and bins go from least to greatest. */
export function curve(series: StripSeries): uPlot.AlignedData {
  const [x, y]: [number[], (number | null)[]] = [[], []]
  const add = (station: number, value: number | null): void => {
    if (x.length && station <= x.at(-1)! && value === null && y.at(-1) !== null) {
      x.push(x.at(-1)! + 1e-6)
      y.push(null)
    } else if (x.length && station <= x.at(-1)!) y[y.length - 1] = value
    else {
      x.push(station)
      y.push(value)
    }
  }
  for (let index = 0; index < series.from_m.length; index++) {
    const [from, to, value] = [series.from_m[index]!, series.to_m[index]!, series.value[index] ?? null]
    const [low, high] = [series.low?.[index], series.high?.[index]]
    if (series.extent !== 'section' && typeof low === 'number' && typeof high === 'number') {
      add(from + (to - from) * 0.25, low)
      add(from + (to - from) * 0.75, high)
      continue
    }
    if (to > from && x.length && from > x.at(-1)! + 1e-6) add(x.at(-1)! + 1e-6, null)
    add(from, value)
    if (to > from) add(to, value)
  }
  return [x, y]
}

export interface ValueAt {
  value: number | null
  sigma: number | null
  reason: string | null
  /** Least and greatest, where the value is the mean of a bin so long. */
  range: [number, number] | null
  long_m: number
}

export function valueAt(series: StripSeries, station_m: number): ValueAt | null {
  let [best, least] = [-1, series.extent === 'section' ? 1e-9 : 2]
  for (let index = 0; index < series.from_m.length; index++) {
    const apart = Math.max(0, series.from_m[index]! - station_m, station_m - series.to_m[index]!)
    if (apart < least) [best, least] = [index, apart]
  }
  if (best < 0) return null
  const [low, high] = [series.low?.[best] ?? null, series.high?.[best] ?? null]
  return {
    value: series.value[best] ?? null,
    sigma: series.sigma[best] ?? null,
    reason: series.reason[best] ?? null,
    range: low === null || high === null ? null : [low, high],
    long_m: series.to_m[best]! - series.from_m[best]!,
  }
}

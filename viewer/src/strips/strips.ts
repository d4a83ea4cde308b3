/** Strips: the condition of a lane by station, a chart a group of figures, linked with the map and the cloud. */

import uPlot from 'uplot'
import type { Desk, Station } from '../core/desk'
import { fill, h } from '../core/dom'
import * as format from '../core/format'
import type { CrossSection, Quantity, Strip, StripIndex, StripLane, StripPiece, StripSeries } from '../core/site'
import { curve, refined, valueAt } from './series'

const COLOURS = { light: ['#0072b2', '#d55e00', '#009e73', '#a6548c', '#9a6a00', '#2b7fb8'], dark: ['#56b4e9', '#f08a4b', '#3cc79b', '#e29cc7', '#f0c04c', '#9ad1f2'] }
const PANEL_PX = 104
const CLOSE_M = 8
/** All values are fetched of no more than this. */
const REFINED_M = 400

interface Drawn {
  /** As the lane's own file has it, and with the pieces that are there. */
  coarse: StripSeries
  found: StripSeries
  lane_id: number
  quantity: Quantity
  colour: string
  other: string | null
}

interface Chart {
  plot: uPlot
  read: HTMLElement
  series: Drawn[]
}

export class Strips {
  readonly element = h('div', { class: 'strips' })
  readonly #charts = h('div', { class: 'charts', tabindex: 0, role: 'application', 'aria-label': 'Strips by station. Left and right step by a metre, with Shift by ten; plus and minus zoom, zero shows all.' })
  readonly #told = h('span', { class: 'number', 'aria-live': 'polite' })
  readonly #strips = new Map<number, Promise<Strip>>()
  /** Pieces that were asked for, by path, and those of each lane that are there. */
  readonly #asked = new Set<string>()
  readonly #pieces = new Map<number, (StripPiece & { series: StripSeries[] })[]>()
  #lane: StripLane
  #strip: Strip | null = null
  #drawn: Chart[] = []
  #moving = false

  constructor(
    readonly desk: Desk,
    readonly index: StripIndex,
    readonly crossSection: (lane: StripLane, section: CrossSection) => void,
  ) {
    this.#lane = index.lanes[0]!
    fill(this.element, this.#head(), this.#charts)
    this.#charts.addEventListener('keydown', (event) => this.#key(event))
    desk.dark.on(() => this.#draw())
    desk.station.on((station) => this.#follow(station))
    new ResizeObserver(() => this.#resize()).observe(this.#charts)
  }

  get lane(): StripLane {
    return this.#lane
  }

  #head(): HTMLElement {
    const { lanes } = this.index
    const surveys = new Set(lanes.map((one) => one.survey))
    const label = (one: StripLane): string => [one.name || one.road, `lane ${one.lane}`, one.direction, surveys.size > 1 ? (one.survey_title ?? one.survey) : null].filter(Boolean).join(' · ')
    const select = h(
      'select',
      { 'aria-label': 'Lane', onchange: () => this.open(Number(select.value)).catch((error) => this.desk.complain(error)) },
      ...lanes.map((one) => h('option', { value: one.lane_id, selected: one === this.#lane }, label(one))),
    )
    const button = h('button', { type: 'button', title: 'The cross-section at the cursor: table and cloud', onclick: () => void this.#cross() }, 'Cross-section')
    return h('div', { class: 'strips-head' }, select, button, this.#told, h('span', { class: 'hint' }, 'Drag across to zoom, double click for all'))
  }

  #load(lane: StripLane): Promise<Strip> {
    let loading = this.#strips.get(lane.lane_id)
    if (!loading) this.#strips.set(lane.lane_id, (loading = this.desk.source.json<Strip>(lane.url)))
    return loading
  }

  async open(lane_id: number): Promise<void> {
    const lane = this.index.lanes.find((one) => one.lane_id === lane_id) ?? this.index.lanes[0]!
    this.#lane = lane
    const select = this.element.querySelector('select')!
    select.value = String(lane.lane_id)
    this.#strip = await this.#load(lane)
    this.#others = await Promise.all(this.index.lanes.filter((one) => one.survey !== lane.survey && one.road === lane.road && one.lane === lane.lane).map((one) => this.#load(one)))
    this.#draw()
  }

  #others: Strip[] = []

  /** What the survey of a strip is called. */
  #surveyOf(strip: Strip): string {
    const lane = this.index.lanes.find((one) => one.lane_id === strip.lane_id)
    return lane?.survey_title ?? lane?.survey ?? ''
  }

  // ---- drawing ----

  #draw(): void {
    const strip = this.#strip
    if (!strip) return
    for (const { plot } of this.#drawn) plot.destroy()
    this.#drawn = []
    const quantities = new Map(this.index.quantities.map((one) => [one.name, one]))
    const there = new Set(strip.series.map((one) => one.quantity))
    const named = new Set(this.index.panels.flatMap((one) => one.quantities))
    const rest = [...there].filter((one) => !named.has(one))
    const panels = [...this.index.panels, ...rest.map((one) => ({ title: quantities.get(one)?.title ?? one, quantities: [one] }))]
    const shown = panels.filter((panel) => panel.quantities.some((one) => there.has(one)))
    fill(this.#charts)
    for (const panel of shown) {
      const listed = panel.quantities.flatMap((one) => quantities.get(one) ?? [])
      this.#panel(panel.title, listed)
    }
    this.#follow(this.desk.station.value)
  }

  #panel(title: string, quantities: Quantity[]): void {
    const dark = this.desk.dark.value
    const colours = dark ? COLOURS.dark : COLOURS.light
    const tables: uPlot.AlignedData[] = []
    const series: Chart['series'] = []
    const options: uPlot.Series[] = [{}]
    for (const strip of [this.#strip!, ...this.#others]) {
      const other = strip === this.#strip ? null : this.#surveyOf(strip)
      for (const [index, quantity] of quantities.entries()) {
        const found = strip.series.find((one) => one.quantity === quantity.name)
        if (!found) continue
        const colour = colours[index % colours.length]!
        const whole = refined(found, this.#pieces.get(strip.lane_id) ?? [])
        tables.push(curve(whole))
        series.push({ coarse: found, found: whole, lane_id: strip.lane_id, quantity, colour, other })
        const stepped = found.extent === 'section'
        options.push({
          label: quantity.title,
          stroke: colour,
          width: other ? 1.2 : 1.6,
          ...(other ? { dash: [4, 3] } : {}),
          ...(stepped ? { paths: uPlot.paths.stepped!({ align: 1 }) } : {}),
          points: { show: false },
        })
      }
    }
    const name = title.slice(0, 1).toUpperCase() + title.slice(1)
    if (!tables.some(([, values]) => (values as (number | null)[]).some((one) => one !== null))) {
      const reason = this.#strip!.series.find((one) => quantities.some(({ name }) => name === one.quantity))?.reason.find((one) => one)
      this.#charts.append(h('p', { class: 'panel-empty' }, `${name}: ${reason ?? 'not measured'}`))
      return
    }
    const read = h('span', { class: 'reads' })
    const holder = h('div', { class: 'chart-holder' })
    const units = [...new Set(quantities.map((one) => one.unit))].join(', ')
    this.#charts.append(h('div', { class: 'panel' }, h('div', { class: 'panel-head' }, h('h3', {}, name, h('span', { class: 'unit' }, ` ${units}`)), read), holder))
    const [text, grid] = dark ? ['#c7ccd1', 'rgba(255,255,255,.08)'] : ['#495057', 'rgba(0,0,0,.08)']
    const axis = { stroke: text, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1, size: 4 }, font: '11px system-ui' }
    const plot = new uPlot(
      {
        width: Math.max(200, holder.clientWidth),
        height: PANEL_PX,
        legend: { show: false },
        cursor: { sync: { key: 'strips', scales: ['x', null] }, drag: { x: true, y: false }, y: false, points: { size: 6 } },
        scales: { x: { time: false, range: (_, low, high) => (this.#zoomed(low, high) ? [low, high] : [...this.#lane.station_m]) } },
        axes: [{ ...axis, size: 22, gap: 2 }, { ...axis, size: 48, gap: 3 }],
        series: options,
        padding: [6, 10, 0, 0],
        hooks: { setCursor: [(one) => this.#cursor(one)], setScale: [(one, key) => key === 'x' && this.#refine(one)] },
      },
      joined(tables),
      holder,
    )
    this.#drawn.push({ plot, read, series })
    this.#readings(this.#drawn.at(-1)!, null)
  }

  #zoomed(low: number, high: number): boolean {
    const [from, to] = this.#lane.station_m
    return low !== null && high - low < (to - from) * 0.98
  }

  /** Fetch the pieces that are seen now, where they are few, and draw their values in place of bins. */
  #refine(plot: uPlot): void {
    const { min, max } = plot.scales['x']!
    if (min == null || max == null || max - min > REFINED_M) return
    const shown = [this.#strip, ...this.#others].flatMap((strip) => this.index.lanes.find((one) => one.lane_id === strip?.lane_id) ?? [])
    for (const lane of shown) {
      const wanted = (lane.pieces ?? []).filter((one) => one.from_m < max && one.to_m > min && !this.#asked.has(one.url))
      for (const piece of wanted) void this.#fetchPiece(lane, piece)
    }
    this.#tellWaiting()
  }

  async #fetchPiece({ lane_id }: StripLane, piece: StripPiece): Promise<void> {
    this.#asked.add(piece.url)
    try {
      const { series } = await this.desk.source.json<{ series: StripSeries[] }>(piece.url)
      this.#pieces.set(lane_id, [...(this.#pieces.get(lane_id) ?? []), { ...piece, series }])
      for (const chart of this.#drawn) this.#redraw(chart, lane_id)
      this.#follow(this.desk.station.value)
    } catch (error) {
      this.#asked.delete(piece.url)
      this.desk.complain(error)
    }
    this.#tellWaiting()
  }

  /** How many of the pieces that were asked for are not there yet. */
  #tellWaiting(): void {
    const there = [...this.#pieces.values()].reduce((sum, list) => sum + list.length, 0)
    this.element.dataset['waiting'] = String(this.#asked.size - there)
  }

  #redraw(chart: Chart, lane_id: number): void {
    const own = chart.series.filter((one) => one.lane_id === lane_id)
    for (const one of own) one.found = refined(one.coarse, this.#pieces.get(lane_id) ?? [])
    if (own.length) chart.plot.setData(joined(chart.series.map((one) => curve(one.found))), false)
    chart.plot.redraw()
  }

  #resize(): void {
    for (const { plot } of this.#drawn) {
      const width = plot.root.parentElement!.clientWidth
      if (width) plot.setSize({ width, height: PANEL_PX })
    }
  }

  // ---- the cursor ----

  #cursor(plot: uPlot): void {
    if (this.#moving || plot.cursor.left === undefined || plot.cursor.left < 0) return
    const station_m = plot.posToVal(plot.cursor.left, 'x')
    if (Number.isFinite(station_m)) this.desk.station.value = { lane_id: this.#lane.lane_id, station_m }
  }

  #follow(station: Station | null): void {
    if (!station || !this.#strip || station.lane_id !== this.#lane.lane_id) return
    this.#told.textContent = `Station ${format.fixed(station.station_m, 2)} m`
    this.#moving = true
    for (const chart of this.#drawn) {
      const left = chart.plot.valToPos(station.station_m, 'x')
      if (Math.abs((chart.plot.cursor.left ?? -1) - left) > 0.5) chart.plot.setCursor({ left, top: 10 }, false)
      this.#readings(chart, station.station_m)
    }
    this.#moving = false
  }

  #readings(chart: Chart, station_m: number | null): void {
    fill(
      chart.read,
      ...chart.series.map((one) => {
        const at = station_m !== null ? valueAt(one.found, station_m) : null
        const name = h('span', { class: one.other ? 'read-name dashed' : 'read-name' }, one.other ? `${one.quantity.title}, ${one.other}` : one.quantity.title)
        name.style.setProperty('--line', one.colour)
        const text = at === null ? '' : at.value === null ? (at.reason ?? 'not measured') : `${format.number(at.value)}${at.sigma === null ? '' : ` ± ${format.number(Number(at.sigma.toPrecision(2)))}`}${at.range ? ` (${at.range.map(format.number).join(' to ')} in ${format.metres(at.long_m, 1)})` : ''}`
        return h('span', { class: 'read', title: one.quantity.meaning }, name, text && h('span', { class: 'number' }, ` ${text}`))
      }),
    )
  }

  #key(event: KeyboardEvent): void {
    const step = event.shiftKey ? 10 : 1
    const [from, to] = this.#lane.station_m
    const now = this.desk.station.value?.lane_id === this.#lane.lane_id ? this.desk.station.value.station_m : from
    const next = { ArrowLeft: now - step, ArrowRight: now + step, Home: from, End: to }[event.key]
    if (next === undefined) {
      if (event.key === 'Enter') void this.#cross()
      else if (event.key === '+' || event.key === '=') this.#zoom(0.5, now)
      else if (event.key === '-') this.#zoom(2, now)
      else if (event.key === '0') this.#zoom(Infinity, now)
      else return
    } else this.desk.station.value = { lane_id: this.#lane.lane_id, station_m: Math.max(from, Math.min(to, next)) }
    event.preventDefault()
    event.stopPropagation()
  }

  /** Show so many times the length of road, around a station. */
  #zoom(factor: number, station_m: number): void {
    const [from, to] = this.#lane.station_m
    const { min, max } = this.#drawn[0]?.plot.scales['x'] ?? {}
    const long = Math.min(((max ?? to) - (min ?? from)) * factor, to - from)
    const low = Math.max(from, Math.min(station_m - long / 2, to - long))
    for (const { plot } of this.#drawn) plot.setScale('x', { min: low, max: low + long })
  }

  // ---- stations and places ----

  /** The lane's middle at a station. */
  placeAt(station: Station): { easting_m: number; northing_m: number } | null {
    const strip = this.#strip
    if (!strip || strip.lane_id !== station.lane_id) return null
    const { station_m, easting_m, northing_m } = strip.line
    let index = station_m.findIndex((one) => one >= station.station_m)
    if (index < 0) index = station_m.length - 1
    if (index === 0) index = 1
    if (!(index in station_m)) return null
    const part = (station.station_m - station_m[index - 1]!) / (station_m[index]! - station_m[index - 1]! || 1)
    const between = (list: number[]): number => list[index - 1]! + (list[index]! - list[index - 1]!) * part
    return { easting_m: between(easting_m), northing_m: between(northing_m) }
  }

  /** The station of the open lane that lies beside a place of the map; null where the lane is far. */
  async stationOf(easting_m: number, northing_m: number): Promise<Station | null> {
    let best: { station: Station; apart: number } | null = null
    const near = ({ bounds_m: b }: StripLane): boolean => !b || (b[0] - CLOSE_M <= easting_m && easting_m <= b[2] + CLOSE_M && b[1] - CLOSE_M <= northing_m && northing_m <= b[3] + CLOSE_M)
    for (const lane of this.index.lanes.filter((one) => one.survey === this.#lane.survey && near(one))) {
      const { line } = await this.#load(lane)
      for (let index = 1; index < line.station_m.length; index++) {
        const [ae, an] = [line.easting_m[index - 1]!, line.northing_m[index - 1]!]
        const [de, dn] = [line.easting_m[index]! - ae, line.northing_m[index]! - an]
        const part = Math.max(0, Math.min(1, ((easting_m - ae) * de + (northing_m - an) * dn) / (de * de + dn * dn || 1)))
        const apart = Math.hypot(easting_m - ae - part * de, northing_m - an - part * dn)
        if (best && apart >= best.apart) continue
        const station_m = line.station_m[index - 1]! + part * (line.station_m[index]! - line.station_m[index - 1]!)
        best = { station: { lane_id: lane.lane_id, station_m }, apart }
      }
    }
    return best && best.apart <= CLOSE_M ? best.station : null
  }

  async goTo(station: Station): Promise<void> {
    if (station.lane_id !== this.#lane.lane_id || !this.#strip) await this.open(station.lane_id)
    this.desk.station.value = { ...station }
  }

  async #cross(): Promise<void> {
    const station = this.desk.station.value?.station_m ?? this.#lane.station_m[0]
    const part = this.#lane.cross_sections.find((one) => one.from_m <= station && station <= one.to_m)
    if (!part) {
      this.desk.say('This lane has no cross-section there.')
      return
    }
    try {
      const { sections } = await this.desk.source.json<{ sections: CrossSection[] }>(part.url)
      const nearest = sections.reduce<CrossSection | null>((best, one) => (!best || Math.abs(one.station_m - station) < Math.abs(best.station_m - station) ? one : best), null)
      if (nearest) this.crossSection(this.#lane, nearest)
    } catch (error) {
      this.desk.complain(error)
    }
  }
}

function joined(tables: uPlot.AlignedData[]): uPlot.AlignedData {
  return tables.length > 1 ? uPlot.join(tables) : tables[0]!
}

/** A section through the cloud as a chart: its points, their median, and where there is one the table's cross-section. */

import uPlot from 'uplot'
import type { Slice } from '../cloud/slice'
import { along } from '../cloud/slice'
import type { Desk } from '../core/desk'
import { fill, h, s } from '../core/dom'
import * as format from '../core/format'
import { css } from '../core/scales'

export interface Curve {
  title: string
  station_m: number[]
  height_m: (number | null)[]
}

export interface SectionRequest {
  title: string
  /** Where the line's stations begin, such as −1.75 for a cross-section that counts from the lane's middle. */
  begin_m: number
  slice: (half_width_m: number) => Promise<Slice>
  curve: Curve | null
}

const DRAWN_POINTS = 40_000

export class SectionPanel {
  readonly element = h('div', { class: 'section-panel' })
  readonly #chart = h('div', { class: 'chart' })
  readonly #legend = h('ul', { class: 'section-legend', 'aria-label': 'Legend of the section' })
  readonly #read = h('span', { class: 'number', 'aria-live': 'off' })
  readonly #told = h('span', { class: 'hint' })
  #plot: uPlot | null = null
  #request: SectionRequest | null = null
  #slice: Slice | null = null
  #half = 0.05
  /** Difference of the cloud's median and the table (mm), for whoever asks. */
  against: { rms_mm: number; greatest_mm: number; count: number } | null = null

  constructor(readonly desk: Desk) {
    fill(this.element, h('p', { class: 'hint' }, 'Draw a section: the tool “Section” of the map or of the cloud, or “Cross-section” of the strips.'))
    new ResizeObserver(() => this.#resize()).observe(this.#chart)
    desk.dark.on(() => this.#draw())
  }

  async show(request: SectionRequest): Promise<void> {
    this.#request = request
    fill(this.element, h('p', { class: 'hint', role: 'status' }, 'Reading the points along the line …'))
    this.#slice = await request.slice(this.#half)
    this.#compare()
    this.#head()
    this.#draw()
  }

  #head(): void {
    const { title } = this.#request!
    const width = h('input', {
      type: 'number',
      min: 0.005,
      max: 5,
      step: 0.005,
      value: this.#half * 2,
      'aria-label': 'Width of the strip (m)',
      onchange: () => {
        const value = Number(width.value)
        if (!(value > 0)) return
        this.#half = value / 2
        this.show(this.#request!).catch((error) => this.desk.complain(error))
      },
    })
    fill(
      this.element,
      h('div', { class: 'section-head' }, h('h2', {}, title), h('label', { class: 'slider' }, 'Width (m)', width), h('button', { type: 'button', onclick: () => this.#save() }, 'Save as CSV'), this.#read, this.#told),
      this.#legend,
      this.#chart,
    )
  }

  /** What is drawn in which colour. */
  #drawLegend(): void {
    const { curve } = this.#request!
    const colours = this.#colours()
    const entry = (mark: SVGElement, text: string): HTMLElement => h('li', {}, s('svg', { viewBox: '0 0 16 10', class: 'key', 'aria-hidden': 'true' }, mark), h('span', {}, text))
    const line = (colour: string, dash: string | null): SVGElement => s('path', { d: 'M0 5h16', stroke: css(colour), 'stroke-width': 2, 'stroke-dasharray': dash, fill: 'none' })
    fill(
      this.#legend,
      entry(s('circle', { cx: 8, cy: 5, r: 2, fill: css(colours.point, 0.8) }), `points within ${format.length(this.#half)} of the line`),
      entry(line(colours.median, null), 'median of the points'),
      curve ? entry(line(colours.table, '5 3'), `${curve.title} of cross-sections`) : null,
    )
  }

  /** How far the cloud's median is from the table, where both are. */
  #compare(): void {
    const { curve, begin_m } = this.#request!
    const slice = this.#slice!
    this.against = null
    const parts = [`${format.fixed(slice.station_m.length, 0)} points`]
    if (!slice.whole) parts.push('not all points of the cloud are in it: the line is too long')
    if (curve) {
      const table = new Map(curve.station_m.map((station, index) => [Math.round(station * 200), curve.height_m[index]]))
      const apart = slice.bins.flatMap((bin) => {
        const height = table.get(Math.round((bin.station_m + begin_m) * 200))
        return height === null || height === undefined ? [] : [(bin.height_m - height) * 1000]
      })
      if (apart.length) {
        const rms_mm = Math.sqrt(apart.reduce((sum, one) => sum + one * one, 0) / apart.length)
        this.against = { rms_mm, greatest_mm: Math.max(...apart.map(Math.abs)), count: apart.length }
        parts.push(`cloud against table: ${format.fixed(rms_mm, 2)} mm RMS at ${apart.length} places`)
      }
    }
    this.#told.textContent = parts.join(' · ')
    this.element.dataset['rms'] = this.against ? this.against.rms_mm.toFixed(4) : ''
  }

  #colours(): { text: string; grid: string; median: string; table: string; point: string } {
    return this.desk.dark.value
      ? { text: '#c7ccd1', grid: 'rgba(255,255,255,.08)', median: '#56b4e9', table: '#e69f00', point: '#9aa1a9' }
      : { text: '#495057', grid: 'rgba(0,0,0,.08)', median: '#0072b2', table: '#d55e00', point: '#868e96' }
  }

  #draw(): void {
    this.#plot?.destroy()
    this.#plot = null
    const slice = this.#slice
    if (!slice || !this.#request) return
    const { begin_m, curve } = this.#request
    const colours = this.#colours()
    this.#drawLegend()
    const tables: uPlot.AlignedData[] = [[slice.bins.map((bin) => bin.station_m + begin_m), slice.bins.map((bin) => bin.height_m)]]
    if (curve) tables.push([curve.station_m, curve.height_m])
    const data = tables.length > 1 ? uPlot.join(tables) : tables[0]!
    const axis = (label: string): uPlot.Axis => ({ stroke: colours.text, grid: { stroke: colours.grid, width: 1 }, ticks: { stroke: colours.grid, width: 1 }, font: '11px system-ui', label, labelFont: '11px system-ui', labelSize: 18 })
    this.#plot = new uPlot(
      {
        width: Math.max(200, this.#chart.clientWidth),
        height: Math.max(120, this.#chart.clientHeight),
        legend: { show: false },
        scales: { x: { time: false }, y: { range: (_, low, high) => this.#range(low, high) } },
        axes: [{ ...axis('Along the line (m)'), size: 34 }, { ...axis('Height (m)'), size: 62, values: (_, ticks) => ticks.map((one) => format.fixed(one, 3)) }],
        series: [
          {},
          { label: 'median of the points', stroke: colours.median, width: 2, points: { show: false } },
          ...(curve ? [{ label: curve.title, stroke: colours.table, width: 1.5, dash: [5, 3], points: { show: false } }] : []),
        ],
        hooks: { drawClear: [(plot) => this.#scatter(plot, colours.point)], setCursor: [(plot) => this.#cursor(plot)] },
      },
      data,
      this.#chart,
    )
  }

  #range(low: number, high: number): [number, number] {
    const heights = this.#slice!.height_m
    let [least, most] = [low ?? Infinity, high ?? -Infinity]
    for (const one of heights) [least, most] = [Math.min(least, one), Math.max(most, one)]
    const room = Math.max(0.005, (most - least) * 0.06)
    return [least - room, most + room]
  }

  #scatter(plot: uPlot, colour: string): void {
    const slice = this.#slice!
    const step = Math.max(1, Math.ceil(slice.station_m.length / DRAWN_POINTS))
    const { ctx } = plot
    ctx.save()
    ctx.beginPath()
    ctx.rect(plot.bbox.left, plot.bbox.top, plot.bbox.width, plot.bbox.height)
    ctx.clip()
    ctx.fillStyle = css(colour, 0.55)
    for (let index = 0; index < slice.station_m.length; index += step) {
      const x = plot.valToPos(slice.station_m[index]! + this.#request!.begin_m, 'x', true)
      const y = plot.valToPos(slice.height_m[index]!, 'y', true)
      ctx.fillRect(x - 1, y - 1, 2, 2)
    }
    ctx.restore()
  }

  #cursor(plot: uPlot): void {
    const { left } = plot.cursor
    if (left === undefined || left < 0) return
    const at = plot.posToVal(left, 'x')
    const slice = this.#slice!
    const wanted = at - this.#request!.begin_m
    const bin = slice.bins.reduce<(typeof slice.bins)[number] | null>((best, one) => (!best || Math.abs(one.station_m - wanted) < Math.abs(best.station_m - wanted) ? one : best), null)
    if (!bin) return
    this.#read.textContent = `${format.fixed(bin.station_m + this.#request!.begin_m, 3)} m: ${format.metres(bin.height_m, 4)} ± ${format.fixed(bin.sigma_m * 1000, 1)} mm`
    const [easting_m, northing_m] = along(slice.line, bin.station_m)
    this.desk.pointer.value = { easting_m, northing_m, height_m: bin.height_m, from: 'section' }
    this.pointed([easting_m, northing_m, bin.height_m])
  }

  /** Called with the place below the cursor. */
  pointed: (place: [number, number, number]) => void = () => {}

  #resize(): void {
    if (this.#chart.clientWidth && this.#chart.clientHeight) this.#plot?.setSize({ width: this.#chart.clientWidth, height: this.#chart.clientHeight })
  }

  #save(): void {
    const { begin_m } = this.#request!
    const slice = this.#slice!
    const lines = slice.bins.map((bin) => {
      const [easting, northing] = along(slice.line, bin.station_m)
      return [bin.station_m + begin_m, easting, northing, bin.height_m, bin.sigma_m].map((one) => one.toFixed(5)).join(',') + `,${bin.count}`
    })
    saveFile('section.csv', 'text/csv', ['along_m,easting_m,northing_m,height_m,sigma_height_m,points', ...lines, ''].join('\n'))
  }
}

/** Offer a text as a file to save. */
export function saveFile(name: string, type: string, content: string): void {
  const url = URL.createObjectURL(new Blob([content], { type }))
  const link = h('a', { href: url, download: name })
  document.body.append(link)
  link.click()
  link.remove()
  window.setTimeout(() => URL.revokeObjectURL(url), 10_000)
}

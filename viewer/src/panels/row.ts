/** The row of what was clicked: values with their σ, units and meaning, and the evidence for it. */

import type { Desk, Place, Selected } from '../core/desk'
import { fill, h, icon } from '../core/dom'
import * as format from '../core/format'
import type { Evidence } from '../core/site'
import type { Hit } from '../map/map'
import { geometryOf } from '../map/vectors'

export interface RowActions {
  openPicture(url: string, place: Place | null): void
  openPictures(place: Place): void
  openTile(tile: string): void
  openRow(layer: string, row: string): void
  openStation(evidence: Evidence): void
  /** Measure a control point in the pictures that see it. */
  measure: ((point: string) => void) | null
  edit: ((selected: Selected) => HTMLElement) | null
  /** Values that an edit gives which was kept and not sent yet. */
  edited: ((selected: Selected) => Record<string, unknown>) | null
}

export class RowPanel {
  readonly element = h('div', { class: 'row-panel' })
  readonly #place = h('section', { class: 'place', hidden: true, 'aria-live': 'polite' })
  readonly #row = h('section', { class: 'details', 'aria-live': 'polite' })
  #hits: Hit[] = []

  constructor(
    readonly desk: Desk,
    readonly actions: RowActions,
  ) {
    this.element.append(this.#place, this.#row)
    desk.selected.on((selected) => this.#draw(selected), true)
    desk.place.on((place) => this.#drawPlace(place))
  }

  /** What lay below the last click; the first is selected. */
  offer(hits: Hit[]): void {
    this.#hits = hits
    this.desk.selected.value = hits[0] ?? null
  }

  #draw(selected: Selected | null): void {
    if (!selected) {
      fill(this.#row, h('p', { class: 'hint' }, 'Click anything on the map to see its row, its σ and its evidence.'))
      return
    }
    const { layer, feature } = selected
    fill(
      this.#row,
      h('header', {}, h('p', { class: 'over' }, layer.title), h('h2', {}, this.#name(selected))),
      this.#others(selected),
      h(
        'div',
        { class: 'actions' },
        this.#action('target', 'Look there', () => this.#goTo(selected)),
        this.#action('copy', 'Copy the row', () => this.#copy(selected)),
        this.desk.survey.pictures ? this.#action('picture', 'Pictures of it', () => this.#withPlace(selected, (place) => this.actions.openPictures(place))) : null,
        this.actions.measure && layer.name === 'control' ? this.#action('point', 'Measure it in pictures', () => this.actions.measure!(String(feature.properties['name']))) : null,
      ),
      this.actions.edit?.(selected) ?? null,
      h('dl', { class: 'values' }, ...this.#values(selected)),
      ...this.#evidence(selected, feature.evidence ?? []),
    )
  }

  #name({ layer, feature }: Selected): string {
    const key = layer.label ?? layer.key
    const named = key ? feature.properties[key] : null
    const title = layer.columns.find((one) => one.name === key)?.title
    if (named === null || named === undefined || named === '') return `${feature.id}`
    return typeof named === 'number' ? `${title ?? key} ${format.value(named)}` : String(named)
  }

  #others(selected: Selected): HTMLElement | null {
    if (this.#hits.length < 2 || !this.#hits.some((one) => one.feature === selected.feature)) return null
    const select = h(
      'select',
      { 'aria-label': 'What lies here', onchange: () => (this.desk.selected.value = this.#hits[Number(select.value)]!) },
      ...this.#hits.map((hit, index) => h('option', { value: index, selected: hit.feature === selected.feature }, `${hit.layer.title}: ${this.#name(hit)}`)),
    )
    return h('label', { class: 'others' }, `${this.#hits.length} lie here`, select)
  }

  #action(name: Parameters<typeof icon>[0], label: string, onclick: () => void): HTMLElement {
    return h('button', { type: 'button', onclick }, icon(name), label)
  }

  #goTo({ feature }: Selected): void {
    const extent = geometryOf(feature.geometry)?.getExtent()
    if (!extent) return
    const size = Math.max(extent[2]! - extent[0]!, extent[3]! - extent[1]!)
    this.desk.goTo({ easting_m: (extent[0]! + extent[2]!) / 2, northing_m: (extent[1]! + extent[3]!) / 2, across_m: Math.max(8, size * 1.6) })
  }

  #copy({ layer, feature }: Selected): void {
    const text = JSON.stringify({ layer: layer.name, id: feature.id, ...feature.properties }, null, 1)
    copyText(text).then(
      () => this.desk.say('The row is in the clipboard.'),
      (error) => this.desk.complain(error),
    )
  }

  #values(selected: Selected): HTMLElement[] {
    const { layer, feature } = selected
    const row = feature.properties
    const edited = this.actions.edited?.(selected) ?? {}
    const sigmas = new Set(layer.columns.map((one) => one.sigma).filter(Boolean))
    return layer.columns
      .filter((column) => !sigmas.has(column.name))
      .map((column) => {
        const isEdited = column.name in edited
        const raw = isEdited ? edited[column.name] : row[column.name]
        const sigma = column.sigma && !isEdited ? row[column.sigma] : null
        const unit = format.unitOf(column) && `\u202f${format.unitOf(column)}`
        const text = /_gps_ns$/.test(column.name) ? format.gpsTime(raw) : format.value(raw)
        return h(
          'div',
          { title: column.meaning ?? undefined },
          h('dt', {}, format.titled(column.title)),
          h(
            'dd',
            { class: typeof raw === 'number' ? 'number' : '' },
            raw === null || raw === undefined ? text : text + unit,
            isEdited && h('span', { class: 'sigma' }, `, edited; it was ${format.value(row[column.name])}`),
            typeof sigma === 'number' && h('span', { class: 'sigma', title: '1 σ' }, ` ± ${format.value(sigma)}`),
          ),
        )
      })
  }

  /** The place of a row: the one that it states, else the middle of its shape, with a height where either has one. */
  #withPlace({ feature }: Selected, then: (place: Place) => void): void {
    const { easting_m, northing_m, height_m } = feature.properties
    const middle = middleOf(feature.geometry)
    if (typeof easting_m === 'number' && typeof northing_m === 'number') then({ easting_m, northing_m, height_m: typeof height_m === 'number' ? height_m : (middle?.[2] ?? null), from: 'row' })
    else if (middle) then({ easting_m: middle[0]!, northing_m: middle[1]!, height_m: middle[2] ?? null, from: 'row' })
  }

  #evidence(selected: Selected, list: Evidence[]): HTMLElement[] {
    if (!list.length) return []
    const link = (name: Parameters<typeof icon>[0], title: string, onclick: () => void): HTMLElement => h('button', { type: 'button', class: 'link', onclick }, icon(name), title)
    const entry = (one: Evidence): HTMLElement => {
      const { kind, url, tile, layer, row } = one
      if (kind === 'picture' && url) return link('picture', one.title, () => this.#withPlace(selected, (place) => this.actions.openPicture(url, place)))
      if (kind === 'cut_out' && url) return this.#cutOut(one.title, url)
      if (kind === 'tile' && tile) return link('fit', one.title, () => this.actions.openTile(tile))
      if (kind === 'row' && layer && row) return link('row', one.title, () => this.actions.openRow(layer, row))
      if (kind === 'station' && this.desk.survey.strips) return link('strips', one.title, () => this.actions.openStation(one))
      return h('span', {}, one.title)
    }
    return [h('h3', {}, 'Evidence'), h('ul', { class: 'evidence' }, ...list.map((one) => h('li', {}, entry(one))))]
  }

  /** A small picture, drawn rather than linked: it may lie in the page itself. */
  #cutOut(title: string, url: string): HTMLElement {
    const canvas = h('canvas', { class: 'cut-out', role: 'img', 'aria-label': title })
    this.desk.source
      .blob(url, 'image/jpeg')
      .then((blob) => createImageBitmap(blob))
      .then((picture) => {
        ;[canvas.width, canvas.height] = [picture.width, picture.height]
        canvas.getContext('2d')!.drawImage(picture, 0, 0)
      })
      .catch((error) => this.desk.complain(error))
    return canvas
  }

  #drawPlace(place: Place | null): void {
    this.#place.hidden = !place
    if (!place) return
    const { crs } = this.desk.survey
    const line = (name: string, text: string, id = ''): HTMLElement => h('div', {}, h('dt', {}, name), h('dd', { class: 'number', 'data-read': id || null }, text))
    fill(
      this.#place,
      h('header', {}, h('p', { class: 'over' }, `Place, from the ${place.from}`)),
      h(
        'dl',
        { class: 'values' },
        line('Easting', format.metres(place.easting_m, 4), 'easting'),
        line('Northing', format.metres(place.northing_m, 4), 'northing'),
        line(`Height${crs.height ? `, ${crs.height}` : ''}`, format.metres(place.height_m, 4), 'height'),
        ...(place.notes ?? []).map(([name, text]) => line(name, text)),
      ),
      h(
        'div',
        { class: 'actions' },
        this.#action('copy', 'Copy', () => {
          const text = [place.easting_m, place.northing_m, place.height_m].filter((one) => one !== null).map((one) => one!.toFixed(4)).join(' ')
          copyText(text).then(() => this.desk.say('The coordinates are in the clipboard.'), (error) => this.desk.complain(error))
        }),
        this.desk.survey.pictures ? this.#action('picture', 'Pictures of it', () => this.actions.openPictures(place)) : null,
      ),
    )
  }
}

/** The place that lies in the middle of a shape: of its corners the one that is nearest to their mean. */
function middleOf(geometry: { type: string; coordinates: any } | null): number[] | null {
  const corners: number[][] = []
  const collect = (one: any): void => void (typeof one?.[0] === 'number' ? corners.push(one) : (one ?? []).forEach(collect))
  collect(geometry?.coordinates)
  if (!corners.length) return null
  const mean = [0, 1].map((axis) => corners.reduce((sum, one) => sum + one[axis]!, 0) / corners.length)
  const apart = (one: number[]): number => Math.hypot(one[0]! - mean[0]!, one[1]! - mean[1]!)
  return corners.reduce((best, one) => (apart(one) < apart(best) ? one : best))
}

/** The clipboard needs a secure page; a file or a host without TLS gets the older way. */
export async function copyText(text: string): Promise<void> {
  if (navigator.clipboard && window.isSecureContext) return navigator.clipboard.writeText(text)
  const area = h('textarea', { 'aria-hidden': 'true' })
  area.value = text
  document.body.append(area)
  area.select()
  document.execCommand('copy')
  area.remove()
}

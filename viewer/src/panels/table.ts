/** All rows of a layer as a table: sorted by a click, narrowed by a text; a row that is chosen is selected on the map. */

import type { Desk } from '../core/desk'
import { fill, h } from '../core/dom'
import * as format from '../core/format'
import type { FeatureDocument } from '../core/site'
import type { FeatureLayer } from '../map/vectors'

const MOST_ROWS = 500

export class TablePanel {
  readonly element = h('div', { class: 'table-panel' })
  #layer: FeatureLayer | null = null
  #rows: FeatureDocument[] = []
  #sort: { name: string; down: boolean } | null = null
  #text = ''

  constructor(
    readonly desk: Desk,
    readonly goTo: (feature: FeatureDocument) => void,
  ) {}

  async open(layer: FeatureLayer): Promise<void> {
    this.#layer = layer
    this.#sort = null
    this.#text = ''
    fill(this.element, h('p', { class: 'hint' }, `Loading the rows of ${layer.document.title} …`))
    this.#rows = await layer.loadAll()
    this.#draw()
  }

  #draw(): void {
    const { document } = this.#layer!
    const search = h('input', {
      type: 'search',
      placeholder: 'Narrow by a text',
      'aria-label': 'Narrow by a text',
      value: this.#text,
      oninput: () => {
        this.#text = search.value
        fill(body, ...this.#lines())
        count.textContent = this.#told()
      },
    })
    const count = h('span', { class: 'count' }, this.#told())
    const body = h('tbody', {}, ...this.#lines())
    const head = document.columns.map((column) => {
      const sorted = this.#sort?.name === column.name ? (this.#sort.down ? 'descending' : 'ascending') : 'none'
      return h(
        'th',
        { scope: 'col', 'aria-sort': sorted, title: column.meaning ?? undefined },
        h('button', { type: 'button', onclick: () => this.#sortBy(column.name) }, format.titled(column.title), format.unitOf(column) ? h('span', { class: 'unit' }, ` ${format.unitOf(column)}`) : null),
      )
    })
    fill(
      this.element,
      h('div', { class: 'table-head' }, h('h2', {}, document.title), count, search),
      h('div', { class: 'table-scroll', tabindex: 0, role: 'region', 'aria-label': `Rows of ${document.title}` }, h('table', {}, h('thead', {}, h('tr', {}, ...head)), body)),
    )
  }

  #told(): string {
    const found = this.#found().length
    return found > MOST_ROWS ? `the first ${MOST_ROWS} of ${format.fixed(found, 0)} rows` : found === 1 ? '1 row' : `${format.fixed(found, 0)} rows`
  }

  #found(): FeatureDocument[] {
    const wanted = this.#text.toLowerCase()
    const rows = wanted ? this.#rows.filter((one) => Object.values(one.properties).some((value) => String(value).toLowerCase().includes(wanted))) : [...this.#rows]
    if (!this.#sort) return rows
    const { name, down } = this.#sort
    const order = (a: unknown, b: unknown): number => {
      if (a === null || a === undefined) return 1
      if (b === null || b === undefined) return -1
      const step = typeof a === 'number' && typeof b === 'number' ? a - b : String(a).localeCompare(String(b))
      return down ? -step : step
    }
    return rows.sort((a, b) => order(a.properties[name], b.properties[name]))
  }

  #sortBy(name: string): void {
    this.#sort = { name, down: this.#sort?.name === name ? !this.#sort.down : false }
    this.#draw()
  }

  #lines(): HTMLElement[] {
    const { document } = this.#layer!
    return this.#found()
      .slice(0, MOST_ROWS)
      .map((feature) => {
        const choose = (): void => {
          this.desk.selected.value = { layer: document, feature }
          this.goTo(feature)
        }
        return h(
          'tr',
          {
            tabindex: 0,
            onclick: choose,
            onkeydown: (event: KeyboardEvent) => {
              if (event.key === 'Enter') choose()
            },
          },
          ...document.columns.map(({ name }) => {
            const raw = feature.properties[name]
            return h('td', { class: typeof raw === 'number' ? 'number' : '' }, /_gps_ns$/.test(name) ? format.gpsTime(raw) : format.value(raw))
          }),
        )
      })
  }
}

/** Edits: confirm, reject, move, correct and add, kept as one document that `roadscan inventory pull` reads. */

import Feature from 'ol/Feature'
import Draw from 'ol/interaction/Draw'
import Modify from 'ol/interaction/Modify'
import VectorLayer from 'ol/layer/Vector'
import VectorSource from 'ol/source/Vector'
import type { Desk, Selected } from '../core/desk'
import { fill, h, icon, iconButton } from '../core/dom'
import type { Layer, Survey } from '../core/site'
import type { MapView } from '../map/map'
import { measuring } from '../map/styles'
import { geometryOf } from '../map/vectors'
import { saveFile } from '../strips/section'

type Action = 'confirm' | 'reject' | 'change' | 'add'

interface Edit {
  layer: string
  action: Action
  id: number | null
  /** The row as it was published. */
  row: Record<string, unknown>
  /** Columns that are corrected. */
  attributes: Record<string, unknown>
  geometry: { type: string; coordinates: unknown } | null
  comment: string
  edited_utc: string
}

const TITLES: Record<Action, string> = { confirm: 'confirmed', reject: 'rejected', change: 'changed', add: 'added' }
const ICONS = { point: 'point', line: 'line', polygon: 'area' } as const

export class Editing {
  readonly element = h('section', { class: 'edits', 'aria-live': 'polite' })
  readonly #edits: Edit[] = []
  readonly #source = new VectorSource()
  readonly #allowed: Set<string>
  #author = ''
  #stop: (() => void) | null = null

  constructor(
    readonly desk: Desk,
    readonly map: MapView,
    readonly rules: NonNullable<Survey['edits']>,
  ) {
    this.#allowed = new Set(rules.layers)
    const layer = new VectorLayer({ source: this.#source, zIndex: 5500 })
    desk.dark.on((dark) => layer.setStyle(measuring(dark)), true)
    map.map.addLayer(layer)
    desk.selected.on(() => this.#end())
    window.addEventListener('beforeunload', (event) => {
      if (this.#edits.length) event.preventDefault()
    })
    this.#draw()
  }

  /** Buttons for the selected row. */
  controls(selected: Selected): HTMLElement {
    if (!this.#allowed.has(selected.layer.name)) return h('p', { class: 'hint' }, 'This layer is not edited here.')
    const body = h('div', { class: 'edit-body' })
    const button = (name: Parameters<typeof icon>[0], title: string, onclick: () => void): HTMLElement => h('button', { type: 'button', onclick }, icon(name), title)
    return h(
      'div',
      { class: 'edit' },
      h(
        'div',
        { class: 'actions' },
        button('check', 'Confirm', () => this.#add(selected, 'confirm', {}, null)),
        button('close', 'Reject', () => this.#add(selected, 'reject', {}, null)),
        button('edit', 'Correct', () => this.#form(selected, body)),
        selected.feature.geometry ? button('point', 'Move', () => this.#move(selected, body)) : null,
      ),
      body,
    )
  }

  #form(selected: Selected, body: HTMLElement): void {
    const inputs = new Map<string, HTMLInputElement>()
    const rows = selected.layer.columns.map((column) => {
      const raw = selected.feature.properties[column.name]
      const input = h('input', { type: typeof raw === 'number' ? 'number' : 'text', step: 'any', value: raw === null || raw === undefined ? '' : String(raw), 'aria-label': column.title })
      inputs.set(column.name, input)
      return h('label', {}, h('span', {}, column.title), input)
    })
    const comment = h('input', { type: 'text', 'aria-label': 'Comment', placeholder: 'Comment' })
    const save = (event: Event): void => {
      event.preventDefault()
      const attributes: Record<string, unknown> = {}
      for (const [name, input] of inputs) {
        const before = selected.feature.properties[name]
        const now = input.value === '' ? null : typeof before === 'number' ? Number(input.value) : input.value
        if (now !== (before ?? null)) attributes[name] = now
      }
      this.#add(selected, 'change', attributes, null, comment.value)
      fill(body)
    }
    fill(body, h('form', { class: 'edit-form', onsubmit: save }, ...rows, comment, h('button', {}, 'Keep the correction')))
  }

  #move(selected: Selected, body: HTMLElement): void {
    this.#end()
    const feature = new Feature(geometryOf(selected.feature.geometry)!)
    this.#source.addFeature(feature)
    const modify = new Modify({ source: this.#source, style: measuring(this.desk.dark.value) })
    this.map.map.addInteraction(modify)
    const done = h('button', { type: 'button', onclick: () => {
      const geometry = feature.getGeometry()!
      this.#end()
      fill(body)
      this.#add(selected, 'change', {}, { type: geometry.getType(), coordinates: geometry.getCoordinates() })
    } }, 'Keep the new place')
    fill(body, h('p', { class: 'hint' }, 'Drag it on the map to where it belongs.'), done)
    this.#stop = () => {
      this.map.map.removeInteraction(modify)
      this.#source.removeFeature(feature)
    }
  }

  #drawNew(layer: Layer): void {
    this.#end()
    const draw = new Draw({ source: this.#source, type: ({ point: 'Point', line: 'LineString', polygon: 'Polygon' } as const)[layer.geometry], style: measuring(this.desk.dark.value) })
    this.desk.say(`Draw the new row of ${layer.title} on the map; a double click ends it, Esc gives it up.`)
    draw.on('drawend', ({ feature }) => {
      const geometry = feature.getGeometry() as any
      this.#end()
      this.#edits.push({ layer: layer.name, action: 'add', id: null, row: {}, attributes: {}, geometry: { type: geometry.getType(), coordinates: geometry.getCoordinates() }, comment: '', edited_utc: new Date().toISOString() })
      this.#draw()
    })
    this.map.map.addInteraction(draw)
    this.#stop = () => this.map.map.removeInteraction(draw)
  }

  /** Give up what is being drawn or moved. */
  #end(): void {
    this.#stop?.()
    this.#stop = null
  }

  #add(selected: Selected, action: Action, attributes: Record<string, unknown>, geometry: Edit['geometry'], comment = ''): void {
    const { layer, feature } = selected
    if (action === 'change' && !Object.keys(attributes).length && !geometry) {
      this.desk.say('Nothing was changed.')
      return
    }
    const before = this.#edits.findIndex((one) => one.layer === layer.name && one.id === feature.id)
    const merged = before >= 0 && action === 'change' && this.#edits[before]!.action === 'change' ? this.#edits[before]! : null
    if (before >= 0) this.#edits.splice(before, 1)
    this.#edits.push({
      layer: layer.name,
      action,
      id: feature.id,
      row: feature.properties,
      attributes: { ...merged?.attributes, ...attributes },
      geometry: geometry ?? merged?.geometry ?? null,
      comment: comment || merged?.comment || '',
      edited_utc: new Date().toISOString(),
    })
    this.#draw()
    this.desk.say(`${layer.title} ${feature.id}: ${TITLES[action]}.`)
  }

  #draw(): void {
    const layers = this.map.layers.map((one) => one.document).filter((one) => this.#allowed.has(one.name))
    const author = h('input', { type: 'text', value: this.#author, placeholder: 'Your name', 'aria-label': 'Your name', oninput: () => (this.#author = author.value) })
    fill(
      this.element,
      h('h3', {}, 'Edits'),
      h('div', { class: 'actions' }, ...layers.map((layer) => h('button', { type: 'button', onclick: () => this.#drawNew(layer) }, icon(ICONS[layer.geometry]), `Add: ${layer.title}`))),
      this.#edits.length ? h('ul', { class: 'edit-list' }, ...this.#edits.map((edit) => this.#line(edit))) : h('p', { class: 'hint' }, 'No edit yet. Select a row to confirm, reject, correct or move it.'),
      this.#edits.length > 0 && h('div', { class: 'actions' }, author, h('button', { type: 'button', class: 'main', onclick: () => this.#save() }, this.rules.post ? 'Send the edits' : 'Save the edits')),
    )
  }

  #line(edit: Edit): HTMLElement {
    const changed = Object.keys(edit.attributes).join(', ')
    const what = [TITLES[edit.action], changed, edit.geometry && edit.action === 'change' ? 'place' : ''].filter(Boolean).join(': ')
    return h('li', {}, h('span', {}, `${edit.layer} ${edit.id ?? 'new'} – ${what}`), iconButton('undo', 'Take this edit back', () => {
      this.#edits.splice(this.#edits.indexOf(edit), 1)
      this.#draw()
    }, { class: 'icon-button small' }))
  }

  /** The document of all edits; coordinates are metres of the survey's map. */
  document(): string {
    const { survey } = this.desk
    const features = this.#edits.map(({ geometry, ...edit }) => ({ type: 'Feature', geometry, properties: { ...edit, author: this.#author } }))
    return JSON.stringify({ type: 'FeatureCollection', coordinates: 'map_m', survey: survey.id, crs: survey.crs.authority, software: survey.software, features }, null, 1)
  }

  async #save(): Promise<void> {
    const content = this.document()
    if (!this.rules.post) {
      saveFile(`${this.desk.survey.id.replace(/[^\w-]/g, '_')}-edits.geojson`, 'application/geo+json', content)
      this.desk.say('The edits are saved as a file: roadscan inventory pull reads it.')
      return
    }
    try {
      const answer = await fetch(new URL(this.rules.post, document.baseURI), { method: 'POST', headers: { 'Content-Type': 'application/geo+json' }, body: content })
      if (!answer.ok) throw new Error(`the edits were not taken: ${answer.status} ${await answer.text()}`)
      this.#edits.length = 0
      this.#draw()
      this.desk.say('The edits are in the survey.')
    } catch (error) {
      this.desk.complain(error)
    }
  }
}

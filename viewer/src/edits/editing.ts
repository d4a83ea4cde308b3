/** Edits: confirm, reject, move, correct and add, kept as one document that `roadscan inventory pull` reads. */

import Feature from 'ol/Feature'
import Draw from 'ol/interaction/Draw'
import Modify from 'ol/interaction/Modify'
import VectorLayer from 'ol/layer/Vector'
import VectorSource from 'ol/source/Vector'
import type { Desk, Selected } from '../core/desk'
import { fill, h, icon, iconButton } from '../core/dom'
import type { Column, EditRules, Layer, Survey } from '../core/site'
import type { MapView } from '../map/map'
import { measuring } from '../map/styles'
import { geometryOf } from '../map/vectors'
import { saveFile } from '../strips/section'

type Action = 'confirm' | 'reject' | 'change' | 'add'

interface Edit {
  layer: string
  action: Action
  asset_id: string | null
  /** Columns that are corrected. */
  attributes: Record<string, unknown>
  geometry: { type: string; coordinates: unknown } | null
  comment: string
  edited_utc: string
}

/** What became of an edit that was sent. */
interface Outcome {
  outcome: 'accepted' | 'same' | 'conflict' | 'refused'
  reason: string
}

const TITLES: Record<Action, string> = { confirm: 'confirmed', reject: 'rejected', change: 'changed', add: 'added' }
const ICONS = { point: 'point', line: 'line', polygon: 'area' } as const
const OUTCOMES: Record<Outcome['outcome'], string> = { accepted: 'accepted', same: 'nothing new', conflict: 'conflict', refused: 'refused' }
const TOKEN_HEADER = 'X-Roadscan-Edit'
const KEPT_TOKEN = 'roadscan-edit'

/** The token of the page's address, which is taken out of it; null where this address allows no edits. */
export function editToken(): string | null {
  const parts = location.hash.slice(1).split('&')
  const given = parts.find((one) => one.startsWith('edit='))?.slice(5) ?? null
  if (given) history.replaceState(null, '', `#${parts.filter((one) => !one.startsWith('edit=')).join('&')}`)
  try {
    if (given) sessionStorage.setItem(KEPT_TOKEN, given)
    return given ?? sessionStorage.getItem(KEPT_TOKEN)
  } catch {
    return given // A browser may keep nothing: the token holds until the page is left.
  }
}

export class Editing {
  readonly element = h('section', { class: 'edits', 'aria-live': 'polite' })
  readonly #edits: Edit[] = []
  readonly #told: { text: string; outcome: Outcome }[] = []
  readonly #source = new VectorSource()
  #author = ''
  #stop: (() => void) | null = null

  constructor(
    readonly desk: Desk,
    readonly map: MapView,
    private rules: EditRules,
    /** Null where edits go into a file. */
    readonly token: string | null,
  ) {
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
    if (!this.rules.layers.includes(selected.layer.name)) return h('p', { class: 'hint' }, 'This layer is not edited here.')
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
    const fields = selected.layer.columns.filter((column) => column.edited).map((column) => [column, field(column, selected.feature.properties[column.name])] as const)
    const comment = h('input', { type: 'text', 'aria-label': 'Comment', placeholder: 'Why: kept with the edit' })
    const save = (event: Event): void => {
      event.preventDefault()
      const attributes: Record<string, unknown> = {}
      for (const [column, input] of fields) {
        const now = valueOf(column, input.value)
        if (now !== (selected.feature.properties[column.name] ?? null)) attributes[column.name] = now
      }
      this.#add(selected, 'change', attributes, null, comment.value)
      fill(body)
    }
    fill(body, h('form', { class: 'edit-form', onsubmit: save }, ...fields.map(([column, input]) => h('label', {}, h('span', {}, column.title), input)), comment, h('button', {}, 'Keep the correction')))
  }

  #move(selected: Selected, body: HTMLElement): void {
    this.#end()
    const feature = new Feature(geometryOf(selected.feature.geometry)!)
    this.#source.addFeature(feature)
    const modify = new Modify({ source: this.#source, style: measuring(this.desk.dark.value) })
    this.map.map.addInteraction(modify)
    this.map.drawing = true
    const done = h('button', { type: 'button', disabled: true, onclick: () => {
      const geometry = feature.getGeometry()!
      this.#end()
      fill(body)
      this.#add(selected, 'change', {}, { type: geometry.getType(), coordinates: geometry.getCoordinates() })
    } }, 'Keep the new place')
    modify.on('modifyend', () => { done.disabled = false })
    fill(body, h('p', { class: 'hint' }, 'Drag it on the map to where it belongs.'), done)
    this.#stop = () => {
      this.map.map.removeInteraction(modify)
      this.map.drawing = false
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
      this.#addNew(layer, geometry.getType(), geometry.getCoordinates()).catch((error) => this.desk.complain(error))
    })
    this.map.map.addInteraction(draw)
    this.map.drawing = true
    this.#stop = () => {
      this.map.map.removeInteraction(draw)
      this.map.drawing = false
    }
  }

  /** A row that was drawn on the map gets the heights of the surface below it. */
  async #addNew(layer: Layer, type: string, flat: any): Promise<void> {
    const raised = async (place: any): Promise<any> => {
      if (typeof place[0] !== 'number') return Promise.all(place.map(raised))
      const height = await this.map.heightAt(place[0], place[1])
      return height === null ? [place[0], place[1]] : [place[0], place[1], height]
    }
    const coordinates = await raised(flat)
    this.#edits.push({ layer: layer.name, action: 'add', asset_id: null, attributes: {}, geometry: { type, coordinates }, comment: '', edited_utc: new Date().toISOString() })
    this.#draw()
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
    const asset_id = String(feature.properties[layer.key ?? ''] ?? feature.id)
    const before = this.#edits.findIndex((one) => one.layer === layer.name && one.asset_id === asset_id)
    const merged = before >= 0 && action === 'change' && this.#edits[before]!.action === 'change' ? this.#edits[before]! : null
    if (before >= 0) this.#edits.splice(before, 1)
    this.#edits.push({
      layer: layer.name,
      action,
      asset_id,
      attributes: { ...merged?.attributes, ...attributes },
      geometry: geometry ?? merged?.geometry ?? null,
      comment: comment || merged?.comment || '',
      edited_utc: new Date().toISOString(),
    })
    this.#draw()
    this.desk.say(`${layer.title} ${asset_id}: ${TITLES[action]}.`)
  }

  #draw(): void {
    const layers = this.map.layers.map((one) => one.document).filter((one) => this.rules.layers.includes(one.name))
    const author = h('input', { type: 'text', value: this.#author, placeholder: 'Your name', 'aria-label': 'Your name', oninput: () => (this.#author = author.value) })
    fill(
      this.element,
      h('h3', {}, 'Edits'),
      h('div', { class: 'actions' }, ...layers.map((layer) => h('button', { type: 'button', onclick: () => this.#drawNew(layer) }, icon(ICONS[layer.geometry]), `Add: ${layer.title}`))),
      this.#told.length > 0 && h('ul', { class: 'edit-told' }, ...this.#told.map(({ text, outcome }) => h('li', { 'data-outcome': outcome.outcome }, h('strong', {}, OUTCOMES[outcome.outcome]), ` ${text}`, outcome.reason && h('p', {}, outcome.reason)))),
      this.#edits.length ? h('ul', { class: 'edit-list' }, ...this.#edits.map((edit) => this.#line(edit))) : h('p', { class: 'hint' }, 'No edit yet. Select a row to confirm, reject, correct or move it.'),
      this.#edits.length > 0 && h('div', { class: 'actions' }, author, h('button', { type: 'button', class: 'main', onclick: () => void this.#save() }, this.rules.post ? 'Send the edits' : 'Save the edits')),
    )
  }

  #text(edit: Edit): string {
    const changed = Object.keys(edit.attributes).join(', ')
    const what = [TITLES[edit.action], changed, edit.geometry && edit.action === 'change' ? 'place' : ''].filter(Boolean).join(': ')
    return `${edit.layer.replace(/^asset_/, '')} ${edit.asset_id ?? 'new'} – ${what}`
  }

  #line(edit: Edit): HTMLElement {
    return h('li', {}, h('span', {}, this.#text(edit)), iconButton('undo', 'Take this edit back', () => {
      this.#edits.splice(this.#edits.indexOf(edit), 1)
      this.#draw()
    }, { class: 'icon-button small' }))
  }

  /** The document of all edits; coordinates are metres of the survey's map. */
  document(): string {
    const { survey } = this.desk
    const features = this.#edits.map(({ geometry, ...edit }) => ({ type: 'Feature', geometry, properties: { ...edit, author: this.#author } }))
    const { inventory, commit } = this.rules
    return JSON.stringify({ type: 'FeatureCollection', coordinates: 'map_m', survey: survey.id, crs: survey.crs.authority, software: survey.software, inventory, commit, features }, null, 1)
  }

  async #save(): Promise<void> {
    const content = this.document()
    if (!this.rules.post) {
      saveFile(`${this.desk.survey.id.replace(/[^\w-]/g, '_')}-edits.geojson`, 'application/geo+json', content)
      this.desk.say('The edits are saved as a file: roadscan inventory pull --home reads it.')
      return
    }
    try {
      const sent = [...this.#edits]
      const headers = { 'Content-Type': 'application/geo+json', [TOKEN_HEADER]: this.token ?? '' }
      const answer = await fetch(new URL(this.rules.post, document.baseURI), { method: 'POST', headers, body: content })
      if (!answer.ok) throw new Error(`The edits were not taken: ${await answer.text()}`)
      await this.#tell(sent, ((await answer.json()) as { edits: Outcome[] }).edits)
    } catch (error) {
      this.desk.complain(error)
    }
  }

  /** Show what became of the edits; those that were refused stay, to be mended. */
  async #tell(sent: Edit[], outcomes: Outcome[]): Promise<void> {
    this.#told.length = 0
    for (const [index, edit] of sent.entries()) {
      const outcome = outcomes[index]!
      this.#told.push({ text: this.#text(edit), outcome })
      if (outcome.outcome !== 'refused' && this.#edits.includes(edit)) this.#edits.splice(this.#edits.indexOf(edit), 1)
    }
    await this.#renew()
    this.#draw()
    const taken = outcomes.filter((one) => one.outcome !== 'refused').length
    this.desk.say(`${taken} of ${sent.length} edits are in the inventory.`)
  }

  /** Show the inventory as it is now, with the same row selected. */
  async #renew(): Promise<void> {
    const survey = await this.desk.source.json<Survey>('survey.json')
    if (survey.edits) this.rules = survey.edits
    const selected = this.desk.selected.value
    this.map.replace(survey.layers.filter((one) => this.rules.layers.includes(one.name)))
    const layer = this.map.layers.find((one) => one.document.name === selected?.layer.name)
    if (!selected || !layer || !this.rules.layers.includes(layer.document.name)) return
    const key = layer.document.key ?? ''
    const feature = (await layer.loadAll()).find((one) => one.properties[key] === selected.feature.properties[key])
    this.desk.selected.value = feature ? { layer: layer.document, feature } : null
  }
}

/** A field of the form for a value; one with a list of values offers them. */
function field(column: Column, raw: unknown): HTMLInputElement | HTMLSelectElement {
  const { type, values } = column.edited!
  const text = raw === null || raw === undefined ? '' : String(raw)
  const choices = type === 'bool' ? ['true', 'false'] : values
  if (choices.length) {
    return h('select', { 'aria-label': column.title }, ...['', ...choices].map((one) => h('option', { value: one, selected: one === text }, one)))
  }
  const kind = type === 'date' ? 'date' : type === 'string' ? 'text' : 'number'
  return h('input', { type: kind, step: type.startsWith('int') ? '1' : 'any', value: text, 'aria-label': column.title })
}

function valueOf(column: Column, text: string): unknown {
  if (text === '') return null
  const { type } = column.edited!
  if (type === 'bool') return text === 'true'
  return type === 'string' || type === 'date' ? text : Number(text)
}

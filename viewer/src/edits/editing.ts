/** Edits: confirm, reject, move, correct and add, kept as one document that `roadscan inventory pull` reads. */

import Feature from 'ol/Feature'
import { unByKey } from 'ol/Observable'
import type { EventsKey } from 'ol/events'
import { getCenter } from 'ol/extent'
import Point from 'ol/geom/Point'
import type SimpleGeometry from 'ol/geom/SimpleGeometry'
import Draw from 'ol/interaction/Draw'
import Modify from 'ol/interaction/Modify'
import Collection from 'ol/Collection'
import VectorLayer from 'ol/layer/Vector'
import VectorSource from 'ol/source/Vector'
import type { Desk, Selected } from '../core/desk'
import { fill, h, icon, iconButton } from '../core/dom'
import { post, Refused } from '../core/server'
import type { Column, EditForms, EditKind, EditRules, Survey } from '../core/site'
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
  /** Set where people said that an unlikely place is right. */
  confirmed?: boolean
}

/** Edits that were not sent yet, as the browser keeps them. */
interface Drafts {
  edits: Edit[]
  author: string
  /** What they were made on. */
  commit: number
  kept_utc: string
}

/** What became of an edit that was sent. */
interface Outcome {
  outcome: 'accepted' | 'same' | 'conflict' | 'asked' | 'refused'
  reason: string
}

const TITLES: Record<Action, string> = { confirm: 'confirmed', reject: 'rejected', change: 'changed', add: 'added' }
const DRAWN = { point: 'Point', line: 'LineString', polygon: 'Polygon' } as const
const HOW = { point: 'Click its place on the map.', line: 'Click its corners on the map; a double click ends it.', polygon: 'Click the corners of its outline on the map; a double click ends it.' } as const
const OUTCOMES: Record<Outcome['outcome'], string> = { accepted: 'accepted', same: 'nothing new', conflict: 'conflict', asked: 'is this right?', refused: 'refused' }
/** The status that an action gives. */
const STATUS: Partial<Record<Action, string>> = { confirm: 'confirmed', reject: 'rejected' }
const STAYS: readonly Outcome['outcome'][] = ['asked', 'refused']
export class Editing {
  readonly element = h('section', { class: 'edits', 'aria-live': 'polite' })
  readonly #edits: Edit[] = []
  readonly #told: { text: string; outcome: Outcome }[] = []
  readonly #source = new VectorSource()
  /** What was drawn, as long as its edit waits here. */
  readonly #drawn = new Map<Edit, Feature>()
  readonly #body = h('div', { class: 'edit-body' })
  #forms: Promise<EditForms> | null = null
  #kind = ''
  #author = ''
  /** The commit that the edits here were made on, which may be older than the one that the page shows. */
  #base: number
  /** What to say of edits that the page was left with. */
  #restored = ''
  readonly #asked = new WeakSet<Edit>()
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
    desk.selected.on(() => {
      if (!this.#body.childElementCount) this.#end() // what is being drawn stays
    })
    window.addEventListener('beforeunload', (event) => {
      if (this.#edits.length || this.#body.childElementCount) event.preventDefault()
    })
    this.#base = rules.commit
    this.#restore()
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
        selected.layer.geometry === 'point' ? null : button('plus', 'Draw anew', () => this.#redraw(selected, body)),
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
    fill(body, h('form', { class: 'edit-form', onsubmit: save }, ...fields.map(([column, input]) => h('label', { title: column.meaning }, h('span', {}, titleOf(column)), input)), comment, h('button', {}, 'Keep the correction')))
  }

  #move(selected: Selected, body: HTMLElement): void {
    this.#end()
    const feature = new Feature(geometryOf(selected.feature.geometry)!)
    this.#source.addFeature(feature)
    const modify = new Modify({ features: new Collection([feature]), style: measuring(this.desk.dark.value) })
    this.map.map.addInteraction(modify)
    this.map.drawing = true
    const done = h('button', { type: 'button', disabled: true, onclick: () => {
      const geometry = feature.getGeometry()!
      this.#end()
      fill(body)
      const before = placesOf(selected.feature.geometry!.coordinates)
      this.#add(selected, 'change', {}, { type: geometry.getType(), coordinates: settled(geometry.getCoordinates(), before) })
    } }, 'Keep the new place')
    modify.on('modifyend', () => { done.disabled = false })
    const put = h('button', { type: 'button', onclick: () => {
      const [geometry, to] = [feature.getGeometry()!, this.map.seen.centre]
      const from = getCenter(geometry.getExtent())
      geometry.translate(to[0] - from[0]!, to[1] - from[1]!)
      done.disabled = false
    } }, 'Put it at the cross')
    fill(body, h('p', { class: 'hint' }, 'Drag it on the map to where it belongs. Without a mouse, the cross in the middle of the map serves.'), h('div', { class: 'actions' }, put, done))
    this.#stop = () => {
      this.map.map.removeInteraction(modify)
      this.map.drawing = false
      this.#source.removeFeature(feature)
    }
  }

  /** Draw the line or the area of a row anew, at the height of the surface. */
  #redraw(selected: Selected, body: HTMLElement): void {
    const { layer, feature } = selected
    this.#drawShape(layer, body, async (drawn) => {
      const { type, coordinates } = shapeOf(drawn)
      const heights = await this.#heightsOf(coordinates)
      const known = heights.some(([, , height]) => height !== null) ? heights : placesOf(feature.geometry!.coordinates)
      this.#end()
      fill(body)
      this.#add(selected, 'change', {}, { type, coordinates: raised(coordinates, known, 0) })
    })
  }

  /** Let a shape be drawn on the map. */
  #drawShape({ title, geometry }: { title: string; geometry: EditKind['geometry'] }, body: HTMLElement, whenDrawn: (feature: Feature) => Promise<void>): void {
    this.#end()
    this.map.tool.value = 'select'
    const draw = new Draw({ source: this.#source, type: DRAWN[geometry], style: measuring(this.desk.dark.value) })
    const button = (title: string, onclick: () => void): HTMLElement => h('button', { type: 'button', onclick }, title)
    const isPoint = geometry === 'point'
    fill(
      body,
      h('p', { class: 'hint' }, `${title}: ${HOW[geometry]} Without a mouse, the cross in the middle of the map serves.`),
      h('div', { class: 'actions' },
        button(isPoint ? 'Put it at the cross' : 'Corner at the cross', () => {
          const place = this.map.seen.centre
          if (isPoint) this.#source.addFeature(new Feature(new Point(place)))
          else draw.appendCoordinates([place])
        }),
        isPoint ? null : button('That was the last', () => draw.finishDrawing()),
        button('Cancel', () => {
          this.#end()
          fill(body)
        })),
    )
    // Draw adds what was drawn to the source, as the button does.
    const key = this.#source.on('addfeature', ({ feature }) => {
      this.#leave(draw, key)
      this.#stop = () => this.#source.removeFeature(feature!)
      whenDrawn(feature!).catch((error) => this.desk.complain(error))
    })
    this.map.map.addInteraction(draw)
    this.map.drawing = true
    this.#stop = () => this.#leave(draw, key)
  }

  /** Draw an asset of a kind on the map, then fill in its form. */
  #drawNew(kind: EditKind): void {
    this.#drawShape(kind, this.#body, (feature) => this.#formNew(kind, feature))
  }

  #leave(draw: Draw, key: EventsKey): void {
    unByKey(key)
    this.map.map.removeInteraction(draw)
    this.map.drawing = false
  }

  /** The form of what was drawn: its kind's columns, and its height where the surface does not tell it. */
  async #formNew(kind: EditKind, feature: Feature): Promise<void> {
    this.#forms ??= this.desk.source.json<EditForms>(this.rules.forms)
    this.#forms.catch(() => (this.#forms = null))
    const shape = shapeOf(feature)
    const [{ columns }, heights] = await Promise.all([this.#forms, this.#heightsOf(shape.coordinates)])
    if (!this.#source.hasFeature(feature)) return
    const fields = columns[kind.layer]!.map((column) => [column, field(column, null)] as const)
    const comment = h('input', { type: 'text', 'aria-label': 'Comment', placeholder: 'Why: kept with the edit' })
    const isKnown = heights.some(([, , height]) => height !== null)
    const height = h('input', { type: 'number', step: 'any', required: !isKnown, 'aria-label': 'Height of the ground m' })
    const keep = (event: Event): void => {
      event.preventDefault()
      const stated = fields.map(([column, input]) => [column.name, valueOf(column, input.value)] as const).filter(([, value]) => value !== null)
      const coordinates = raised(shape.coordinates, heights, Number(height.value))
      const edit: Edit = { layer: kind.layer, action: 'add', asset_id: null, attributes: Object.fromEntries(stated), geometry: { type: shape.type, coordinates }, comment: comment.value, edited_utc: new Date().toISOString() }
      this.#drawn.set(edit, feature)
      this.#edits.push(edit)
      this.#stop = null
      fill(this.#body)
      this.#draw()
    }
    fill(
      this.#body,
      h('form', { class: 'edit-form', 'aria-label': `New: ${kind.title}`, onsubmit: keep },
        isKnown ? null : h('label', {}, h('span', {}, 'Height of the ground, m'), height),
        ...fields.map(([column, input]) => h('label', { title: column.meaning }, h('span', {}, titleOf(column)), input)),
        comment,
        h('div', { class: 'actions' }, h('button', { class: 'main' }, `Keep the new ${kind.title}`), h('button', { type: 'button', onclick: () => this.#end() }, 'Cancel'))),
    )
  }

  /** Places of a shape with the height of the surface there; null where no raster knows it. */
  #heightsOf(coordinates: unknown): Promise<Raised[]> {
    return Promise.all(placesOf(coordinates).map(async ([e, n]): Promise<Raised> => [e, n, await this.map.heightAt(e, n)]))
  }

  /** Give up what is being drawn or moved. */
  #end(): void {
    this.#stop?.()
    this.#stop = null
    fill(this.#body)
  }

  /** Values that the edit of a row gives, while it waits here. */
  edited({ layer, feature }: Selected): Record<string, unknown> {
    const asset_id = String(feature.properties[layer.key ?? ''] ?? feature.id)
    const edit = this.#edits.find((one) => one.layer === layer.name && one.asset_id === asset_id)
    if (!edit) return {}
    const status = STATUS[edit.action]
    return { ...edit.attributes, ...(status ? { status } : {}) }
  }

  /** An edit that is here no more. */
  #forget(edit: Edit): void {
    const at = this.#edits.indexOf(edit)
    if (at >= 0) this.#edits.splice(at, 1)
    const drawn = this.#drawn.get(edit)
    if (drawn) this.#source.removeFeature(drawn)
    this.#drawn.delete(edit)
  }

  #add(selected: Selected, action: Action, attributes: Record<string, unknown>, geometry: Edit['geometry'], comment = ''): void {
    const { layer, feature } = selected
    if (action === 'change' && !Object.keys(attributes).length && !geometry) {
      this.desk.say('Nothing was changed.')
      return
    }
    const asset_id = String(feature.properties[layer.key ?? ''] ?? feature.id)
    const at = this.#edits.findIndex((one) => one.layer === layer.name && one.asset_id === asset_id)
    const before = at >= 0 ? this.#edits.splice(at, 1)[0]! : null
    // What was said of the asset before stays: a correction, a new place, and that it was confirmed or rejected.
    const status = STATUS[action] ?? attributes['status'] ?? (before && (STATUS[before.action] ?? before.attributes['status']))
    const all = { ...before?.attributes, ...attributes, ...(status ? { status } : {}) }
    const shape = geometry ?? before?.geometry ?? null
    const said = (['confirm', 'reject'] as const).find((one) => STATUS[one] === status)
    const isStatusAlone = said !== undefined && !shape && Object.keys(all).length === 1
    const edit: Edit = {
      layer: layer.name,
      action: isStatusAlone ? said : 'change',
      asset_id,
      attributes: isStatusAlone ? {} : all,
      geometry: shape,
      comment: comment || before?.comment || '',
      edited_utc: new Date().toISOString(),
    }
    this.#edits.push(edit)
    this.#draw()
    this.desk.say(`${layer.title} ${asset_id}: ${TITLES[action]}.`)
  }

  // ---- drafts ----

  /** Drafts belong to a site, a survey and its inventory: pages of one host share what a browser keeps. */
  get #keptAs(): string {
    return `roadscan-edits ${location.pathname} ${this.desk.survey.id} ${this.rules.inventory}`
  }

  /** Keep the edits that were not sent for the next time; nothing where there is none. */
  #keep(): void {
    try {
      if (!this.#edits.length) localStorage.removeItem(this.#keptAs)
      else localStorage.setItem(this.#keptAs, JSON.stringify({ edits: this.#edits, author: this.#author, commit: this.#base, kept_utc: new Date().toISOString() } satisfies Drafts))
    } catch {
      // A browser may keep nothing: leaving the page asks.
    }
  }

  /** Take up the edits that were here when the page was left, and say so. */
  #restore(): void {
    try {
      const drafts = JSON.parse(localStorage.getItem(this.#keptAs) ?? 'null') as Drafts | null
      if (!drafts?.edits.length || !drafts.edits.every((one) => one.action in TITLES && one.attributes)) return
      this.#edits.push(...drafts.edits)
      this.#author = drafts.author
      this.#base = drafts.commit
      for (const edit of drafts.edits.filter((one) => one.action === 'add' && one.geometry)) {
        const feature = new Feature(geometryOf(edit.geometry)!)
        this.#drawn.set(edit, feature)
        this.#source.addFeature(feature)
      }
      const count = drafts.edits.length
      this.element.dataset['restored'] = String(count)
      const when = new Date(drafts.kept_utc).toLocaleString()
      this.#restored = count === 1 ? `1 edit of ${when} that was not sent is here again.` : `${count} edits of ${when} that were not sent are here again.`
      queueMicrotask(() => this.desk.say(this.#restored)) // once the page listens
    } catch {
      // What cannot be read is none of this page's edits.
    }
  }

  #draw(): void {
    if (!this.#edits.length) [this.#base, this.#restored] = [this.rules.commit, '']
    this.#keep()
    const shown = this.desk.selected.value
    if (shown) queueMicrotask(() => this.desk.selected.value === shown && (this.desk.selected.value = { ...shown })) // its values
    const { kinds } = this.rules
    const kind = h('select', { 'aria-label': 'Kind of the new asset', onchange: () => (this.#kind = kind.value) }, ...kinds.map((one) => h('option', { value: one.layer, selected: one.layer === this.#kind }, one.title)))
    const author = h('input', { type: 'text', value: this.#author, placeholder: 'Your name', 'aria-label': 'Your name', oninput: () => { this.#author = author.value; this.#keep() } })
    fill(
      this.element,
      h('h3', {}, 'Edits'),
      h('div', { class: 'actions' }, kind, h('button', { type: 'button', onclick: () => this.#drawNew(kinds.find((one) => one.layer === kind.value)!) }, icon('plus'), 'Draw a new one')),
      this.#body,
      this.#told.length > 0 && h('ul', { class: 'edit-told' }, ...this.#told.map(({ text, outcome }) => h('li', { 'data-outcome': outcome.outcome }, h('strong', {}, OUTCOMES[outcome.outcome]), ` ${text}`, outcome.reason && h('p', {}, outcome.reason)))),
      this.#restored && h('p', { class: 'hint' }, this.#restored),
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
    const right = this.#asked.has(edit) && !edit.confirmed && h('button', { type: 'button', onclick: () => {
      edit.confirmed = true
      this.#draw()
    } }, 'It is right')
    return h('li', {}, h('span', {}, `${this.#text(edit)}${edit.confirmed ? ', confirmed' : ''}`), right, iconButton('undo', 'Take this edit back', () => {
      this.#forget(edit)
      this.#draw()
    }, { class: 'icon-button small' }))
  }

  /** The document of all edits; coordinates are metres of the survey's map. */
  document(): string {
    const { survey } = this.desk
    const features = this.#edits.map(({ geometry, ...edit }) => ({ type: 'Feature', geometry, properties: { ...edit, author: this.#author } }))
    const { inventory } = this.rules
    return JSON.stringify({ type: 'FeatureCollection', coordinates: 'map_m', survey: survey.id, crs: survey.crs.authority, software: survey.software, inventory, commit: this.#base, features }, null, 1)
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
      const { edits } = await post<{ edits: Outcome[] }>(this.rules.post, content, this.token, 'application/geo+json')
      await this.#tell(sent, edits)
    } catch (error) {
      this.desk.complain(error instanceof Refused ? `The edits were not taken: ${error.message}` : error)
    }
  }

  /** Show what became of the edits; those that were refused stay, to be mended. */
  async #tell(sent: Edit[], outcomes: Outcome[]): Promise<void> {
    this.#told.length = 0
    for (const [index, edit] of sent.entries()) {
      const outcome = outcomes[index]!
      this.#told.push({ text: this.#text(edit), outcome })
      if (!STAYS.includes(outcome.outcome)) this.#forget(edit)
      if (outcome.outcome === 'asked') this.#asked.add(edit)
    }
    await this.#renew()
    this.#base = this.rules.commit // people have seen what became of them
    this.#draw()
    const taken = outcomes.filter((one) => !STAYS.includes(one.outcome)).length
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

/** A place with its height; null where it is not known. */
type Raised = readonly [number, number, number | null]

/** What was drawn, as a document states it. */
function shapeOf(feature: Feature): { type: string; coordinates: any } {
  const geometry = feature.getGeometry() as SimpleGeometry
  return { type: geometry.getType(), coordinates: geometry.getCoordinates() }
}

/** All places of a shape's coordinates, however these are nested; what was just drawn has no heights. */
function placesOf(coordinates: any): Raised[] {
  return typeof coordinates[0] === 'number' ? [coordinates] : coordinates.flatMap(placesOf)
}

/** Coordinates of a changed shape: a corner that was added got the height 0, and gets that of the nearest corner before. */
function settled(coordinates: any, before: readonly Raised[]): any {
  if (before.some(([, , height]) => !height)) return coordinates
  if (typeof coordinates[0] !== 'number') return coordinates.map((one: any) => settled(one, before))
  return coordinates[2] === 0 ? raised(coordinates, before, 0) : coordinates
}

/** Coordinates with heights: the surface's, where it is unknown that of the nearest place that has one, else the one given. */
function raised(coordinates: any, heights: readonly Raised[], given_m: number): any {
  if (typeof coordinates[0] !== 'number') return coordinates.map((one: any) => raised(one, heights, given_m))
  const [e, n] = coordinates as [number, number]
  const apart = ([x, y]: Raised): number => Math.hypot(x - e, y - n)
  const known = heights.filter(([, , height]) => height !== null)
  const nearest = known.reduce<Raised | null>((best, one) => (best && apart(best) <= apart(one) ? best : one), null)
  return [e, n, nearest ? nearest[2] : given_m]
}

/** A column as a form names it, with its unit. */
function titleOf({ title, unit }: Column): string {
  return unit && !['text', 'number', '1', 'date'].includes(unit) ? `${title}, ${unit}` : title
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

/** The page: puts its parts side by side and passes between them what people point at. */

import { ModelParts } from './parts'
import type { Desk, Place, ViewName } from './core/desk'
import { fill, h, icon, iconButton } from './core/dom'
import * as format from './core/format'
import { MapView } from './map/map'
import { editToken } from './core/server'
import { Editing } from './edits/editing'
import { helpDialog } from './panels/help'
import { layersPanel } from './panels/layers'
import { Measurements } from './panels/measurements'
import { RowPanel } from './panels/row'
import { findRows, layerOfKind, onMap, parseSearch } from './panels/search'
import { TablePanel } from './panels/table'

const TITLES: Record<ViewName, [Parameters<typeof icon>[0], string, string]> = {
  map: ['map', 'Map', 'M'],
  cloud: ['cube', '3D', 'C'],
  pictures: ['picture', 'Pictures', 'P'],
  strips: ['strips', 'Strips', 'S'],
}

const NARROW = window.matchMedia('(max-width: 760px)')
const WIDE = window.matchMedia('(min-width: 1180px)')

export class App {
  readonly element = h('div', { class: 'app' })
  readonly map: MapView
  readonly parts: ModelParts
  readonly #views = new Map<ViewName, HTMLElement>()
  readonly #stage = h('main', { class: 'stage', 'aria-label': 'Views' })
  readonly #dock = h('section', { class: 'dock', 'aria-label': 'Strips, sections and rows', hidden: true })
  readonly #left = h('aside', { class: 'side left', 'aria-label': 'Layers' })
  readonly #layers = h('div')
  readonly #right = h('aside', { class: 'side right', 'aria-label': 'Details' })
  readonly #toast = h('div', { class: 'toast', role: 'status', hidden: true })
  readonly #found = h('ul', { class: 'search-found', 'aria-label': 'What was found', hidden: true })
  readonly #help = helpDialog()
  readonly #rows: RowPanel
  readonly #table: TablePanel
  readonly #measurements: Measurements
  readonly #editing: Editing | null
  readonly #available: ViewName[]
  #docked: 'strips' | 'section' | 'table' = 'strips'

  constructor(readonly desk: Desk) {
    const { survey } = desk
    this.#available = ['map', ...(survey.clouds ? (['cloud'] as const) : []), ...(survey.pictures ? (['pictures'] as const) : []), ...(survey.strips ? (['strips'] as const) : [])]
    this.map = new MapView(desk)
    this.#measurements = new Measurements(desk)
    const token = survey.edits?.post || survey.measuring?.control ? editToken() : null
    this.parts = new ModelParts(desk, this.map, this.#measurements, () => this.#openDock('section'), token)
    this.#editing = survey.edits && (token || !survey.edits.post) ? new Editing(desk, this.map, survey.edits, token) : null
    this.#rows = new RowPanel(desk, {
      openPicture: (url, place) => void this.parts.openPicture(url, place),
      openPictures: (place) => void this.parts.picturesOf(place),
      openTile: (tile) => void this.#goToRow('tiles', tile).then((found) => found || this.#goToTile(tile)),
      openRow: (layer, row) => void this.#goToRow(layer, row),
      openStation: ({ road, lane, station_m }) => {
        this.#openDock('strips')
        void this.parts.goToStationOf(road ?? '', lane ?? null, station_m ?? 0)
      },
      measure: this.parts.takesControl ? (point) => void this.parts.measureControl(point) : null,
      edit: this.#editing && ((selected) => this.#editing!.controls(selected)),
      edited: this.#editing && ((selected) => this.#editing!.edited(selected)),
    })
    this.#table = new TablePanel(desk, (feature) => this.#lookAt(feature))
    this.#drawLayers()
    this.#build()
    this.#listen()
  }

  #build(): void {
    const { survey } = this.desk
    document.title = `${survey.title || survey.id} · roadscan`
    for (const name of this.#available) {
      if (name === 'strips') continue
      const view = h('section', { class: 'view', 'data-view': name, 'aria-label': TITLES[name][1], hidden: true })
      this.#views.set(name, view)
      this.#stage.append(view)
    }
    this.#views.get('map')!.append(this.map.element, this.parts.mapTools())
    fill(
      this.#left,
      h('div', { class: 'side-head' }, h('h2', {}, 'Layers'), iconButton('close', 'Close the list of layers', () => this.#open(null), { class: 'icon-button sheet-close' })),
      this.#layers,
      this.#about(),
    )
    fill(
      this.#right,
      h('div', { class: 'side-head sheet-only' }, h('h2', {}, 'Details'), iconButton('close', 'Close the details', () => this.#open(null), { class: 'icon-button sheet-close' })),
      this.#rows.element,
      this.#measurements.element,
      this.#editing?.element ?? null,
    )
    fill(this.element, this.#header(), this.#left, this.#stage, this.#right, this.#dock, this.#footer(), this.#toast, this.#help)
  }

  #drawLayers(): void {
    fill(
      this.#layers,
      layersPanel(this.map, (layer) => {
        this.#table.open(layer).catch((error) => this.desk.complain(error))
        this.#openDock('table')
      }),
    )
  }

  /** What is left out, and files for other programs. */
  #about(): HTMLElement {
    const { survey, source } = this.desk
    const files = source.single ? [] : [...(survey.features ?? []), ...(survey.cogs ?? []), ...(survey.catalog ? [survey.catalog.collection, survey.catalog.items, survey.catalog.points] : [])].filter((one) => one !== null)
    const left = survey.left_out ?? []
    return h(
      'footer',
      { class: 'about' },
      left.length > 0 && h('details', {}, h('summary', {}, `${left.length} left out`), h('ul', {}, ...left.map((one) => h('li', {}, one)))),
      files.length > 0 && h('details', {}, h('summary', {}, 'Files for other programs'), h('ul', {}, ...files.map((one) => h('li', {}, h('a', { href: one, download: '' }, one.split('/').at(-1)!))))),
      h('div', { class: 'row' }, h('span', { class: 'grow' }, survey.software), survey.report && h('a', { href: survey.report }, 'Report')),
    )
  }

  #header(): HTMLElement {
    const { survey } = this.desk
    const { crs } = survey
    const about = [crs.authority ?? crs.name ?? 'local frame', crs.height ? `${crs.height} heights` : null].filter(Boolean).join(' · ')
    const search = h('input', { type: 'search', id: 'search', placeholder: 'Name, id, kind, E N, lat, lon, @station', 'aria-label': 'Go to a name, an id, a kind, a place, a row or a station', autocomplete: 'off' })
    const form = h('form', { class: 'search', role: 'search', onsubmit: (event: Event) => { event.preventDefault(); void this.#search(search.value) } }, icon('search'), search, this.#found)
    return h(
      'header',
      { class: 'top' },
      h('div', { class: 'title' }, h('h1', {}, survey.title || survey.id), h('p', { title: crs.name ?? '' }, about)),
      h('nav', { class: 'views', 'aria-label': 'Views' }, ...this.#available.map((name) => this.#viewButton(name))),
      form,
      h(
        'div',
        { class: 'tools' },
        iconButton('layers', 'Layers (L)', () => this.#open('left'), { class: 'icon-button sheet-open' }),
        iconButton('row', 'Details', () => this.#open('right'), { class: 'icon-button sheet-open' }),
        iconButton('sun', 'Light or dark', () => (this.desk.dark.value = !this.desk.dark.value)),
        iconButton('help', 'Keys and help (?)', () => this.#help.showModal()),
      ),
    )
  }

  #viewButton(name: ViewName): HTMLElement {
    const [drawn, title, key] = TITLES[name]
    const button = h('button', { type: 'button', 'aria-pressed': 'false', title: `${title} (${key})`, onclick: () => this.#toggle(name) }, icon(drawn), h('span', {}, title))
    this.desk.views.on((views) => button.setAttribute('aria-pressed', String(views.has(name))), true)
    return button
  }

  #footer(): HTMLElement {
    const [e, n, z, more] = ['E', 'N', 'H', ''].map(() => h('span', { class: 'number' }))
    this.desk.pointer.on((place) => {
      e!.textContent = place ? `E ${format.fixed(place.easting_m, 3)}` : ''
      n!.textContent = place ? `N ${format.fixed(place.northing_m, 3)}` : ''
      z!.textContent = place?.height_m !== null && place ? `H ${format.fixed(place.height_m!, 4)}` : ''
      more!.textContent = place ? (place.notes ?? []).map(([name, text]) => `${name} ${text}`).join('  ') : ''
    })
    return h('footer', { class: 'status' }, e, n, z, more, h('span', { class: 'spring' }), this.parts.tip)
  }

  #listen(): void {
    const { desk } = this
    this.map.clicked = (place, hits) => {
      desk.place.value = place
      this.#rows.offer(hits)
      if (NARROW.matches && hits.length) this.#open('right')
    }
    this.map.replaced = () => this.#drawLayers()
    desk.views.on((views) => this.#arrange(views), true)
    desk.message.on((message) => this.#say(message))
    desk.dark.on((dark) => {
      document.documentElement.dataset['theme'] = dark ? 'dark' : 'light'
      keep('roadscan-theme', dark ? 'dark' : 'light')
    })
    desk.dark.value = (kept('roadscan-theme') ?? (matchMedia('(prefers-color-scheme: dark)').matches ? 'dark' : 'light')) === 'dark'
    document.documentElement.dataset['theme'] = desk.dark.value ? 'dark' : 'light'
    document.addEventListener('keydown', (event) => this.#key(event))
    window.addEventListener('hashchange', () => void this.#followHash())
  }

  begin(): void {
    const { survey } = this.desk
    const first: ViewName[] = ['map']
    if (WIDE.matches && survey.clouds) first.push('cloud')
    if (!NARROW.matches && survey.strips) first.push('strips')
    const asked = this.#viewsOf(new URLSearchParams(location.hash.slice(1)))
    if (asked.length) first.splice(1, first.length, ...asked.filter((one) => one !== 'map'))
    this.#dock.hidden = !first.includes('strips')
    for (const [name, view] of this.#views) view.hidden = !first.includes(name)
    if (first.includes('cloud')) this.parts.prepareCloud()
    requestAnimationFrame(() => {
      this.map.map.updateSize()
      this.map.fit(undefined, 0)
      this.map.map.once('rendercomplete', () => {
        performance.mark('roadscan-map')
        this.element.dataset['ready'] = 'map'
        this.map.look() // without rasters, no further picture tells that the map has moved
        // The rest waits until the map is there.
        this.desk.views.value = new Set(first)
        this.parts.startPictures()
        void this.#followHash()
        window.setTimeout(() => void this.parts.fetchCode().then(() => (this.element.dataset['code'] = 'all')), 1500)
      })
      this.map.map.render()
    })
  }

  // ---- which views are shown ----

  #toggle(name: ViewName): void {
    const views = new Set(this.desk.views.value)
    if (NARROW.matches && name !== 'strips') {
      for (const other of ['map', 'cloud', 'pictures'] as const) if (other !== name) views.delete(other)
      views.add(name)
    } else if (views.has(name)) views.delete(name)
    else views.add(name)
    if (![...views].some((one) => one !== 'strips')) views.add('map')
    if (name === 'strips' && views.has('strips')) this.#docked = 'strips'
    this.desk.views.value = views
  }

  #arrange(views: ReadonlySet<ViewName>): void {
    for (const [name, element] of this.#views) element.hidden = !views.has(name)
    this.#stage.dataset['count'] = String([...this.#views.values()].filter((one) => !one.hidden).length)
    this.#dock.hidden = !views.has('strips')
    if (views.has('strips')) this.#drawDock()
    if (views.has('cloud')) void this.parts.openCloud(this.#views.get('cloud')!)
    this.parts.setActive(views)
    if (views.has('pictures')) void this.parts.openPictures(this.#views.get('pictures')!)
  }

  #openDock(tab: 'strips' | 'section' | 'table'): void {
    this.#docked = tab
    if (this.desk.views.value.has('strips')) this.#drawDock()
    else this.desk.show('strips')
  }

  #drawDock(): void {
    const tabs = ([['strips', 'Strips'], ['section', 'Section'], ['table', 'Rows']] as const).filter(([name]) => name !== 'strips' || this.desk.survey.strips)
    if (this.#docked === 'strips' && !this.desk.survey.strips) this.#docked = 'table'
    const body = h('div', { class: 'dock-body', role: 'tabpanel', id: 'dock-body' })
    fill(
      this.#dock,
      h('div', { class: 'dock-head' },
        h('div', { class: 'tabs', role: 'tablist', 'aria-label': 'What the dock shows' },
          ...tabs.map(([name, title]) => h('button', { type: 'button', role: 'tab', 'aria-controls': 'dock-body', 'aria-selected': String(name === this.#docked), onclick: () => { this.#docked = name; this.#drawDock() } }, title))),
        iconButton('close', 'Close the dock', () => { const views = new Set(this.desk.views.value); views.delete('strips'); this.desk.views.value = views })),
      body,
    )
    if (this.#docked === 'table') body.append(this.#table.element.childElementCount ? this.#table.element : h('p', { class: 'hint' }, 'The table button of a layer shows its rows here.'))
    if (this.#docked === 'section') body.append(this.parts.section.element)
    if (this.#docked === 'strips') void this.parts.openStrips(body)
  }

  /** On small screens, the sides are sheets over the view. */
  #open(side: 'left' | 'right' | null): void {
    this.element.dataset['sheet'] = side && this.element.dataset['sheet'] !== side ? side : ''
  }

  #say(message: { text: string; wrong: boolean } | null): void {
    this.#toast.hidden = !message
    if (!message) return
    this.#toast.textContent = message.text
    this.#toast.classList.toggle('wrong', message.wrong)
    window.setTimeout(() => {
      if (this.desk.message.value === message) this.desk.message.value = null
    }, message.wrong ? 9000 : 3500)
  }

  // ---- going somewhere ----

  #lookAt(feature: { geometry: { type: string; coordinates: any } | null }): void {
    const flat = (feature.geometry?.coordinates.flat(8) ?? []) as number[]
    const width = depthOf(feature.geometry)
    const [es, ns] = [flat.filter((_, index) => index % width === 0), flat.filter((_, index) => index % width === 1)]
    if (!es.length) return
    const [e0, e1, n0, n1] = [Math.min(...es), Math.max(...es), Math.min(...ns), Math.max(...ns)]
    this.desk.goTo({ easting_m: (e0 + e1) / 2, northing_m: (n0 + n1) / 2, across_m: Math.max(8, 1.6 * Math.max(e1 - e0, n1 - n0)) })
  }

  #goToTile(tile: string): void {
    const [column, row] = tile.split('_').map(Number) as [number, number]
    const size = this.desk.survey.tile_m
    if (Number.isFinite(column) && Number.isFinite(row)) this.desk.goTo({ easting_m: (column + 0.5) * size, northing_m: (row + 0.5) * size, across_m: size * 1.5 })
  }

  /** Go to a row by the column that tells rows apart, or by its number in the layer. */
  async #goToRow(name: string, id: string): Promise<boolean> {
    const layer = this.map.layers.find((one) => one.document.name === name)
    if (!layer) return false
    const rows = await layer.loadAll()
    const { key } = layer.document
    const feature = rows.find((one) => key !== null && String(one.properties[key]) === id) ?? rows.find((one) => String(one.id) === id)
    if (!feature) return false
    layer.setVisible(true)
    this.desk.selected.value = { layer: layer.document, feature }
    this.#lookAt(feature)
    return true
  }

  async #search(text: string): Promise<void> {
    this.#found.hidden = true
    const wanted = parseSearch(text, this.desk.survey.extent_m)
    if (wanted.kind === 'place') {
      void this.#place({ easting_m: wanted.easting_m, northing_m: wanted.northing_m, height_m: wanted.height_m, from: 'search' })
      this.desk.goTo({ ...wanted, across_m: 20 })
    } else if (wanted.kind === 'tile') this.#goToTile(wanted.tile)
    else if (wanted.kind === 'station' && this.desk.survey.strips) await this.parts.goToStation(wanted.station_m, null)
    else if (wanted.kind === 'degrees') this.#goToDegrees(wanted.latitude_deg, wanted.longitude_deg)
    else if (wanted.kind === 'row' && (await this.#goToRow(wanted.layer, wanted.id))) return
    else if (wanted.kind !== 'station') await this.#find(text.trim())
  }

  /** Show a place that was looked for; its height, where none was given, is that of the surface there. */
  async #place(place: Place): Promise<void> {
    this.desk.place.value = place
    if (place.height_m !== null) return
    const height_m = await this.map.heightAt(place.easting_m, place.northing_m)
    if (this.desk.place.value === place && height_m !== null) this.desk.place.value = { ...place, height_m }
  }

  /** Go to latitude and longitude, and say what the numbers were taken for; the other way round where only that lies here. */
  #goToDegrees(latitude_deg: number, longitude_deg: number): void {
    const { degrees, crs } = this.desk.survey
    if (!degrees) return this.desk.complain(`Latitude and longitude are not known on this map (${crs.authority ?? crs.name ?? 'a local frame'}): give easting and northing in metres.`)
    const asGiven = onMap(degrees, longitude_deg, latitude_deg)
    const place = asGiven ?? onMap(degrees, latitude_deg, longitude_deg)
    const [lat, lon] = asGiven ? [latitude_deg, longitude_deg] : [longitude_deg, latitude_deg]
    if (!place) return this.desk.complain(`Latitude ${latitude_deg}°, longitude ${longitude_deg}° (WGS 84) is more than 2 km outside of the survey.`)
    const [easting_m, northing_m] = place
    void this.#place({ easting_m, northing_m, height_m: null, from: 'search', notes: [['Latitude', `${lat}°`], ['Longitude', `${lon}°`]] })
    this.desk.goTo({ easting_m, northing_m, across_m: 20 })
    this.desk.say(`Taken for latitude ${lat}°, longitude ${lon}° (WGS 84)${asGiven ? '' : ', in this order'}: E ${format.fixed(easting_m, 2)}, N ${format.fixed(northing_m, 2)}.`)
  }

  /** Look for a kind, or for rows by id, name and text; one is gone to, several are offered. */
  async #find(text: string): Promise<void> {
    if (!text) return
    const kind = layerOfKind(this.map.layers, text)
    if (kind) {
      kind.setVisible(true)
      this.map.look()
      this.#drawLayers()
      await this.#table.open(kind)
      this.#openDock('table')
      this.desk.say(`${kind.document.title}: ${format.fixed(kind.document.features, 0)}.`)
      return
    }
    const { found, left } = await findRows(this.map.layers, text)
    this.element.dataset['found'] = String(found.length)
    const rest = left.length ? ` Not looked through, as they are large: ${left.join(', ')}.` : ''
    if (!found.length) return this.desk.complain(`“${text}” is no name, id or kind here.${rest} Or give easting and northing in metres, latitude and longitude in degrees, a tile as COLUMN_ROW, a row as LAYER/ID, a station as @METRES.`)
    const show = ({ layer, feature }: (typeof found)[number]): void => {
      this.#found.hidden = true
      layer.setVisible(true)
      this.desk.selected.value = { layer: layer.document, feature }
      this.#lookAt(feature)
    }
    if (found.length === 1) return show(found[0]!)
    fill(this.#found, ...found.map((one) => h('li', {}, h('button', { type: 'button', onclick: () => show(one) }, one.text))))
    this.#found.hidden = false
  }

  async #followHash(): Promise<void> {
    const { hash } = location
    await this.#goToHash(new URLSearchParams(hash.slice(1)))
    this.element.dataset['at'] = hash
  }

  /** The views that a link asks for. */
  #viewsOf(asked: URLSearchParams): ViewName[] {
    return (asked.get('views') ?? '').split(',').filter((one): one is ViewName => this.#available.includes(one as ViewName))
  }

  async #goToHash(asked: URLSearchParams): Promise<void> {
    const views = this.#viewsOf(asked)
    if (views.length) this.desk.views.value = new Set(views)
    const at = (asked.get('at') ?? '').split(',').map(Number)
    const across_m = Number(asked.get('zoom')) || 30
    if (at.length >= 2 && at.every(Number.isFinite)) this.desk.goTo({ easting_m: at[0]!, northing_m: at[1]!, height_m: at[2] ?? null, across_m })
    const row = parseSearch(asked.get('row') ?? '') // an id may hold slashes, spaces and signs
    if (row.kind === 'row') await this.#goToRow(row.layer, row.id)
    const station = asked.get('station')
    if (station && this.desk.survey.strips) await this.parts.goToStationOf(asked.get('road'), asked.get('lane'), Number(station))
  }

  #key(event: KeyboardEvent): void {
    const inside = event.target as HTMLElement
    if (event.ctrlKey || event.metaKey || event.altKey || inside.closest('dialog')) return
    if (event.key === 'Escape') return this.#escape(inside)
    if (inside.matches('input, select, textarea')) return
    const view = this.#available.find((name) => TITLES[name][2].toLowerCase() === event.key.toLowerCase())
    if (view) this.#toggle(view)
    else if (event.key === '/') document.getElementById('search')!.focus()
    else if (event.key === '?') this.#help.showModal()
    else if (event.key.toLowerCase() === 'l') this.#open('left')
    else return
    event.preventDefault()
  }

  #escape(inside: HTMLElement): void {
    if (inside.matches('input[type=search]')) inside.blur()
    this.#open(null)
    if (!this.parts.abort()) {
      this.desk.place.value = null
      this.desk.selected.value = null
    }
  }
}

/** Numbers of a coordinate: 2, or 3 with heights. */
function depthOf(geometry: { coordinates: any } | null): number {
  let inner = geometry?.coordinates
  while (Array.isArray(inner?.[0])) inner = inner[0]
  return inner?.length ?? 2
}

function keep(name: string, value: string): void {
  try {
    localStorage.setItem(name, value)
  } catch {
    // A page that is opened as a file may keep nothing.
  }
}

function kept(name: string): string | null {
  try {
    return localStorage.getItem(name)
  } catch {
    return null
  }
}

/** Elements whose text is always text: nothing here parses HTML. */

export type Child = Node | string | number | null | undefined | false
type Value = string | number | boolean | null | undefined | EventListener | ((event: any) => void)

/** An element with attributes, `on…` listeners and children. A boolean `true` attribute is set empty. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Record<string, Value> = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag)
  setAttributes(element, attributes)
  append(element, children)
  return element
}

const SVG = 'http://www.w3.org/2000/svg'

/** The same of SVG. */
export function s(tag: string, attributes: Record<string, Value> = {}, ...children: Child[]): SVGElement {
  const element = document.createElementNS(SVG, tag)
  setAttributes(element, attributes)
  append(element, children)
  return element
}

function setAttributes(element: Element, attributes: Record<string, Value>): void {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue
    if (name.startsWith('on') && typeof value === 'function') {
      element.addEventListener(name.slice(2), value as EventListener)
    } else if (name === 'style' || name.startsWith('on')) {
      throw new Error(`attribute ${name} is not set as text`)
    } else {
      element.setAttribute(name, value === true ? '' : String(value))
    }
  }
}

function append(element: Element, children: Child[]): void {
  for (const child of children) {
    if (child === null || child === undefined || child === false) continue
    element.append(child instanceof Node ? child : String(child))
  }
}

/** Replace what an element holds. What had the focus in it gives it to what takes its place: who uses keys stays there. */
export function fill(element: Element, ...children: Child[]): void {
  const focused = document.activeElement
  const place = focused && focused !== element && element.contains(focused) ? placeIn(element, focused) : null
  element.replaceChildren()
  append(element, children)
  if (place && !element.contains(document.activeElement)) alike(element, place.name)[place.number]?.focus()
}

/** By what an element of a kind is told from others. */
function nameOf(element: Element): string {
  return `${element.tagName} ${element.getAttribute('aria-label') ?? (element.tagName === 'BUTTON' ? element.textContent : '')}`
}

function alike(within: Element, name: string): HTMLElement[] {
  return [...within.querySelectorAll<HTMLElement>(name.split(' ', 1)[0]!)].filter((one) => nameOf(one) === name)
}

function placeIn(within: Element, element: Element): { name: string; number: number } {
  const name = nameOf(element)
  return { name, number: alike(within, name).indexOf(element as HTMLElement) }
}

/** A drawing of 16 × 16 units from path data of this program. */
export function icon(name: keyof typeof ICONS): SVGElement {
  return s(
    'svg',
    { viewBox: '0 0 16 16', class: 'icon', 'aria-hidden': 'true', focusable: 'false' },
    ...ICONS[name].split('|').map((d) => s('path', { d })),
  )
}

const ICONS = {
  map: 'M1.5 3.5l4-1.5 5 2 4-1.5v10l-4 1.5-5-2-4 1.5z|M5.5 2v10|M10.5 4v10',
  cube: 'M8 1.5l5.5 3v7L8 14.5l-5.5-3v-7z|M2.5 4.5L8 7.5l5.5-3|M8 7.5v7',
  picture: 'M1.5 3h13v10h-13z|M1.5 11l4-4 3 3 2-2 4 4|M11 5.5a.5.5 0 1 0 .01 0',
  strips: 'M1.5 12l3-5 3 3 3-7 4 6|M1.5 14.5h13',
  layers: 'M8 1.5l6.5 3.5L8 8.5 1.5 5z|M1.5 8L8 11.5 14.5 8|M1.5 11L8 14.5l6.5-3.5',
  row: 'M2 3h12v10H2z|M2 6.5h12|M6 6.5V13',
  table: 'M2 3h12v10H2z|M2 6.3h12|M2 9.6h12|M7 3v10',
  ruler: 'M1.5 10.5l9-9 4 4-9 9z|M4 8l1.5 1.5|M6 6l2 2|M8 4l1.5 1.5',
  height: 'M8 2v12|M5 5l3-3 3 3|M5 11l3 3 3-3',
  profile: 'M1.5 12c3 0 3-6 6-6s3 4 7 3|M1.5 14.5h13',
  section: 'M2 2v12|M14 2v12|M2 9c3-2 4 1 6 0s4-1 6 0',
  fit: 'M2 6V2h4|M10 2h4v4|M14 10v4h-4|M6 14H2v-4',
  plus: 'M8 3v10|M3 8h10',
  minus: 'M3 8h10',
  close: 'M3.5 3.5l9 9|M12.5 3.5l-9 9',
  sun: 'M8 5a3 3 0 1 0 .01 0|M8 1v1.5|M8 13.5V15|M1 8h1.5|M13.5 8H15|M3 3l1 1|M12 12l1 1|M13 3l-1 1|M4 12l-1 1',
  help: 'M5.5 6a2.5 2.5 0 1 1 3.5 2.3c-.7.3-1 .8-1 1.7|M8 12.8v.2',
  edit: 'M3 13l.5-3 7-7 2.5 2.5-7 7z|M9 4.5L11.5 7',
  check: 'M3 8.5l3.5 3.5L13 4.5',
  point: 'M8 5.5a2.5 2.5 0 1 0 .01 0',
  line: 'M3 12L8 5l5 4',
  area: 'M3 12L5 4l7-1 2 7z',
  target: 'M8 3.5a4.5 4.5 0 1 0 .01 0|M8 1v4|M8 11v4|M1 8h4|M11 8h4',
  down: 'M8 2v8|M4.5 7L8 10.5 11.5 7|M2.5 13.5h11',
  left: 'M10 3L5 8l5 5',
  right: 'M6 3l5 5-5 5',
  undo: 'M3 6h6.5a3.5 3.5 0 0 1 0 7H6|M6 3L3 6l3 3',
  copy: 'M5 5h9v9H5z|M5 11H2V2h9v3',
  search: 'M7 2.5a4.5 4.5 0 1 0 .01 0|M10.5 10.5L14 14',
} as const

/** A button with an icon, a name for screen readers and a tooltip; `key` is the shortcut that it names. */
export function iconButton(
  name: keyof typeof ICONS,
  label: string,
  onclick: (event: MouseEvent) => void,
  attributes: Record<string, Value> = {},
): HTMLButtonElement {
  return h('button', { type: 'button', class: 'icon-button', 'aria-label': label, title: label, onclick, ...attributes }, icon(name))
}

/** What all parts of the page share: the survey, what is selected, where people point. */

import { Signal } from './signal'
import type { FeatureDocument, Layer, Survey } from './site'
import type { Source } from './source'

export type ViewName = 'map' | 'cloud' | 'pictures' | 'strips'

export interface Place {
  easting_m: number
  northing_m: number
  height_m: number | null
  /** Where it was read. */
  from: string
  /** What else is known of it, such as the class of a point. */
  notes?: [string, string][]
}

export interface Selected {
  layer: Layer
  feature: FeatureDocument
}

export interface Station {
  lane_id: number
  station_m: number
}

/** Where to look: the middle, and the width that should be seen. */
export interface Target {
  easting_m: number
  northing_m: number
  height_m?: number | null
  across_m?: number
}

export class Desk {
  readonly selected = new Signal<Selected | null>(null)
  readonly place = new Signal<Place | null>(null)
  readonly pointer = new Signal<Place | null>(null)
  readonly station = new Signal<Station | null>(null)
  readonly target = new Signal<Target | null>(null)
  readonly views = new Signal<ReadonlySet<ViewName>>(new Set(['map']))
  readonly message = new Signal<{ text: string; wrong: boolean } | null>(null)
  readonly dark = new Signal(false)
  /** Feature of one view that another shows: a picture by its index, a tile by its name. */
  readonly picture = new Signal<number | null>(null)

  constructor(
    readonly survey: Survey,
    readonly source: Source,
  ) {}

  say(text: string): void {
    this.message.value = { text, wrong: false }
  }

  complain(error: unknown): void {
    this.message.value = { text: error instanceof Error ? error.message : String(error), wrong: true }
  }

  show(view: ViewName): void {
    if (!this.views.value.has(view)) this.views.value = new Set([...this.views.value, view])
  }

  goTo(target: Target): void {
    this.target.value = { ...target }
  }
}

/** A value that tells its listeners when it changes. */
export class Signal<T> {
  #value: T
  readonly #listeners = new Set<(value: T, before: T) => void>()

  constructor(value: T) {
    this.#value = value
  }

  get value(): T {
    return this.#value
  }

  set value(value: T) {
    const before = this.#value
    if (Object.is(value, before)) return
    this.#value = value
    for (const listener of [...this.#listeners]) listener(value, before)
  }

  /** Call `listener` at every change, and now if `now` is set; returns what ends that. */
  on(listener: (value: T, before: T) => void, now = false): () => void {
    this.#listeners.add(listener)
    if (now) listener(this.#value, this.#value)
    return () => this.#listeners.delete(listener)
  }
}

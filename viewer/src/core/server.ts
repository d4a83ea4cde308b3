/** What the server of `roadscan view` is asked: a site that was published has none. */

const TOKEN_HEADER = 'X-Roadscan-Edit'
const KEPT_TOKEN = 'roadscan-edit'

/** The server answered, and did not do what it was asked. */
export class Refused extends Error {}

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

/** The server's answer to a document; `Refused` has its words where it does not take it. */
export async function post<T>(path: string, content: string, token: string | null = null, type = 'application/json'): Promise<T> {
  const headers = { 'Content-Type': type, ...(token ? { [TOKEN_HEADER]: token } : {}) }
  let answer: Response
  try {
    answer = await fetch(new URL(path, document.baseURI), { method: 'POST', headers, body: content })
  } catch {
    throw new Error('The server does not answer: is `roadscan view` still running?')
  }
  if (!answer.ok) throw new Refused((await answer.text()).trim())
  return (await answer.json()) as T
}
